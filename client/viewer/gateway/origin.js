// Who may talk to the gateway. A page of another site can make a browser send requests here; its name is in the Origin
// header of WebSocket upgrades. A site whose name resolves to this machine's address would match its own Host header,
// so the host has to be one of ours as well.
import net from 'node:net';
import os from 'node:os';

const loopback = ['127.0.0.1', 'localhost', '[::1]'];

// "host" or "host:port" without the port, in lower case; '' when it is none.
function nameOf(hostHeader) {
  const match = /^(\[[0-9a-fA-F:.]+\]|[^:[\]/@\s]+)(?::\d{1,5})?$/.exec(hostHeader ?? '');
  return match === null ? '' : match[1].toLowerCase();
}

// A check of Host headers for a server that listens on `listenHost`.
export function hostCheck(listenHost, alsoAllowed = []) {
  const own = net.isIPv6(listenHost) ? `[${listenHost}]` : listenHost.toLowerCase();
  const names = new Set([own, ...alsoAllowed.map((name) => name.toLowerCase())]);
  const everywhere = listenHost === '0.0.0.0' || listenHost === '::';
  if (everywhere || loopback.includes(own)) for (const name of loopback) names.add(name);
  if (everywhere) names.add(os.hostname().toLowerCase());
  return (hostHeader) => {
    const name = nameOf(hostHeader);
    // A number cannot be made to resolve to another address.
    return name !== '' && (names.has(name) || (everywhere && net.isIP(name.replace(/^\[|\]$/g, '')) !== 0));
  };
}

// Whether an upgrade comes from a page that this gateway has served.
export function sameOrigin(headers) {
  const { origin, host } = headers;
  return typeof origin === 'string' && typeof host === 'string' &&
    (origin.toLowerCase() === `http://${host.toLowerCase()}` || origin.toLowerCase() === `https://${host.toLowerCase()}`);
}
