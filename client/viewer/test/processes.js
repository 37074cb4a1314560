// Programs that a test starts, each in a group of its own, so that none of them is left behind.
import { spawn } from 'node:child_process';
import fs from 'node:fs';
import path from 'node:path';

const groups = new Set();

function kill(child) {
  try {
    process.kill(-child.pid, 'SIGKILL');
  } catch {
    // It has ended.
  }
  groups.delete(child);
}

process.on('exit', () => groups.forEach(kill));
for (const signal of ['SIGINT', 'SIGTERM', 'SIGHUP']) process.on(signal, () => process.exit(130));

// Resolves with the child and the match of `pattern` in what it prints. Rejects when it ends before.
export function startUntil(command, args, pattern, seconds = 20) {
  const child = spawn(command, args, { detached: true, stdio: ['pipe', 'pipe', 'pipe'] });
  groups.add(child);
  let text = '';
  return new Promise((resolve, reject) => {
    const timer = setTimeout(() => reject(new Error(`${command} did not get ready: ${text}`)), seconds * 1000);
    const take = (data) => {
      text += data;
      const match = pattern.exec(text);
      if (match === null) return;
      clearTimeout(timer);
      resolve({ child, match });
    };
    child.stdout.on('data', take);
    child.stderr.on('data', take);
    child.on('error', reject);
    child.on('exit', (code) => {
      clearTimeout(timer);
      reject(new Error(`${command} ended with ${code}: ${text}`));
    });
  });
}

// Asks it to end, and makes it end when it does not.
export async function stop(child, seconds = 5) {
  if (child === undefined) return;
  if (child.exitCode === null && child.signalCode === null) {
    const ended = new Promise((resolve) => child.once('exit', resolve));
    const timer = setTimeout(() => kill(child), seconds * 1000);
    child.kill('SIGINT');
    await ended;
    clearTimeout(timer);
  }
  kill(child);
}

// Runs a world. The servers: ["host:port", ...]; its control plane: "host:port".
export async function startWorld(bin, worldFile) {
  // It ends by itself even when nobody is left to end it.
  const args = ['up', worldFile, '--duration', '3m', '--hash-every', '0'];
  const ready = /servers:\s*((?:[\w.[\]:-]+:\d+[, ]*)+)\ncontrol plane (\S+)\n/;
  const { child, match } = await startUntil(path.join(bin, 'aureole'), args, ready);
  return { child, servers: match[1].split(/[,\s]+/).filter((s) => s !== ''), control: match[2] };
}

export function findChromium() {
  const names = [process.env.CHROMIUM, '/usr/bin/chromium', '/usr/bin/chromium-browser', '/usr/bin/google-chrome'];
  return names.find((name) => name && fs.existsSync(name)) ?? null;
}
