// Which files a request may have: those of the built page, and the recordings.
import fs from 'node:fs/promises';
import path from 'node:path';

const types = {
  '.html': 'text/html; charset=utf-8', '.js': 'text/javascript; charset=utf-8', '.css': 'text/css; charset=utf-8',
  '.svg': 'image/svg+xml', '.png': 'image/png', '.json': 'application/json', '.mcap': 'application/octet-stream',
};

export function typeOf(file) {
  return types[path.extname(file)] ?? 'application/octet-stream';
}

// The file of `folder` that the path of a URL names, links resolved; null when there is none inside.
export async function fileIn(folder, urlPath) {
  let relative;
  try {
    relative = decodeURIComponent(urlPath).replace(/^\/+/, '');
  } catch {
    return null;
  }
  if (relative.includes('\0') || relative.includes('\\')) return null;
  if (relative.split('/').some((part) => part.startsWith('.'))) return null;
  try {
    const root = await fs.realpath(folder);
    const file = await fs.realpath(path.join(root, relative));
    if (!file.startsWith(root + path.sep) || !(await fs.stat(file)).isFile()) return null;
    return file;
  } catch {
    return null;
  }
}

// A recording of `folder` by its name, likewise. Names have no folders in them.
export async function recordingIn(folder, urlName) {
  const file = /^[^/]+\.mcap$/.test(urlName) && !/%2f/i.test(urlName) ? await fileIn(folder, urlName) : null;
  return file !== null && file.endsWith('.mcap') ? file : null;
}

// [{ name, bytes }, ...], the newest first; empty when the folder cannot be read.
export async function listRecordings(folder) {
  let names;
  try {
    names = await fs.readdir(folder);
  } catch {
    return [];
  }
  const out = [];
  for (const name of names) {
    const file = name.endsWith('.mcap') ? await recordingIn(folder, encodeURIComponent(name)) : null;
    if (file === null) continue;
    const stat = await fs.stat(file);
    out.push({ name, bytes: stat.size, modified: stat.mtimeMs });
  }
  return out.sort((a, b) => b.modified - a.modified).map(({ name, bytes }) => ({ name, bytes }));
}
