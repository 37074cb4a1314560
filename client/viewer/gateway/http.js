// Serves the built page and the recordings.
import fs from 'node:fs';
import { pipeline } from 'node:stream';
import { fileIn, listRecordings, recordingIn, typeOf } from './files.js';

const headers = {
  'X-Content-Type-Options': 'nosniff',
  'Referrer-Policy': 'no-referrer',
  'Cross-Origin-Resource-Policy': 'same-origin',
  'Content-Security-Policy':
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
};

// A listener for node's http server. `hostAllowed`: of origin.js. `recordings`: '' for none.
export function pageHandler({ dist, recordings, live, hostAllowed }) {
  return (request, response) => {
    answer({ dist, recordings, live, hostAllowed }, request, response).catch((error) => {
      console.error(`gateway: ${request.url}: ${error.message}`);
      if (!response.headersSent) refuse(response, 500, 'something went wrong\n');
      else response.destroy();
    });
  };
}

async function answer({ dist, recordings, live, hostAllowed }, request, response) {
  if (!hostAllowed(request.headers.host)) return refuse(response, 403, 'not a host name of this viewer; see --allow-host\n');
  if (request.method !== 'GET' && request.method !== 'HEAD') return refuse(response, 405, 'GET only\n');
  const urlPath = request.url.split(/[?#]/, 1)[0];
  if (urlPath === '/settings.json') {
    const list = recordings === '' ? [] : await listRecordings(recordings);
    return send(request, response, JSON.stringify({ live, recordings: list }), 'application/json');
  }
  if (urlPath.startsWith('/recordings/')) {
    const file = recordings === '' ? null : await recordingIn(recordings, urlPath.slice('/recordings/'.length));
    return file === null ? refuse(response, 404, 'no such recording\n') : sendFile(request, response, file, 'no-store');
  }
  const file = await fileIn(dist, urlPath === '/' ? '/index.html' : urlPath);
  if (file === null) return refuse(response, 404, 'no such page\n');
  // Names in assets/ have a hash of what is in them.
  return sendFile(request, response, file, urlPath.startsWith('/assets/') ? 'max-age=31536000, immutable' : 'no-cache');
}

function refuse(response, status, text) {
  response.writeHead(status, { ...headers, 'Content-Type': 'text/plain; charset=utf-8' });
  response.end(text);
}

function send(request, response, text, type) {
  response.writeHead(200, { ...headers, 'Content-Type': type, 'Cache-Control': 'no-store' });
  response.end(request.method === 'HEAD' ? undefined : text);
}

function sendFile(request, response, file, cache) {
  const bytes = fs.statSync(file).size;
  response.writeHead(200, { ...headers, 'Content-Type': typeOf(file), 'Content-Length': bytes, 'Cache-Control': cache });
  if (request.method === 'HEAD' || bytes === 0) return response.end();
  // A file that grows is served as long as it was.
  pipeline(fs.createReadStream(file, { end: bytes - 1 }), response, () => {});
}
