// The gateway as a whole: HTTP, WebSockets, and one session per browser.
import http from 'node:http';
import net from 'node:net';
import { WebSocketServer } from 'ws';
import { pageHandler } from './http.js';
import { hostCheck, sameOrigin } from './origin.js';
import { Rpc } from './rpc.js';
import { Session } from './session.js';

const mostBrowsers = 32;
const longestMessage = 256 << 10;  // bytes, from a browser
const heartbeat = 10_000;          // ms; a browser that misses one is gone

// Resolves to { url, close() } when browsers may come. Rejects when the address cannot be had.
export async function startGateway({ root, dist, server, listen, recordings, allowedHosts }) {
  const hostAllowed = hostCheck(listen.host, allowedHosts);
  const rpc = new Rpc(root);
  const sessions = new Set();
  const web = http.createServer(pageHandler({ dist, recordings, live: server !== '', hostAllowed }));
  const sockets = new WebSocketServer({ noServer: true, maxPayload: longestMessage, perMessageDeflate: false });

  web.on('upgrade', (request, socket, head) => {
    const reason = refusal(request, hostAllowed, sessions.size);
    if (reason !== '') {
      socket.on('error', () => {});
      socket.end(`HTTP/1.1 ${reason}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n`);
      return;
    }
    sockets.handleUpgrade(request, socket, head, (webSocket) => {
      const session = new Session({ socket: webSocket, rpc, server });
      sessions.add(session);
      webSocket.alive = true;
      webSocket.on('pong', () => (webSocket.alive = true));
      webSocket.on('close', () => sessions.delete(session));
    });
  });

  const beat = setInterval(() => {
    for (const { socket } of sessions) {
      if (!socket.alive) socket.terminate();
      socket.alive = false;
      if (socket.readyState === socket.OPEN) socket.ping();
    }
  }, heartbeat);

  await new Promise((resolve, reject) => {
    web.once('error', reject);
    web.listen(listen.port, listen.host, resolve);
  });
  const host = net.isIPv6(listen.host) ? `[${listen.host}]` : listen.host;
  return {
    url: `http://${host}:${web.address().port}/`,
    async close() {
      clearInterval(beat);
      for (const session of sessions) session.close();
      rpc.close();
      sockets.close();
      web.closeAllConnections();
      await new Promise((resolve) => web.close(resolve));
    },
  };
}

// Why an upgrade is refused; '' when it is not.
function refusal(request, hostAllowed, browsers) {
  if (request.url.split('?', 1)[0] !== '/socket') return '404 Not Found';
  if (!hostAllowed(request.headers.host) || !sameOrigin(request.headers)) return '403 Forbidden';
  if (browsers >= mostBrowsers) return '503 Service Unavailable';
  return '';
}
