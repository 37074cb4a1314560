// Recordings for tests, by the program that users have.
import { execFile } from 'node:child_process';
import fs from 'node:fs/promises';
import path from 'node:path';
import { promisify } from 'node:util';

const run = promisify(execFile);

// Records what goes on for so many seconds of simulated time.
export async function recordWorld(bin, server, file, seconds) {
  await run(path.join(bin, 'aureole'), ['record', '--server', server, '--out', file, '--duration', `${seconds}s`],
    { timeout: 60_000 });
}

// For @mcap/core's reader.
export async function readableFile(file) {
  const bytes = await fs.readFile(file);
  return {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + length))),
  };
}
