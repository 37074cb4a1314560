#!/usr/bin/env node
// Between browsers and the region servers of a world: serves the page, passes frames on, and forwards inputs.
import fs from 'node:fs';
import { fileURLToPath } from 'node:url';
import { BadFlags, help, parseFlags } from './gateway/flags.js';
import { startGateway } from './gateway/gateway.js';
import { loadProto } from './gateway/proto.js';

const dist = fileURLToPath(new URL('dist', import.meta.url));

function fail(message, code) {
  console.error(`gateway: ${message}`);
  process.exit(code);
}

function readFlags() {
  try {
    const options = parseFlags(process.argv.slice(2));
    if (options.recordings !== '' && !fs.statSync(options.recordings, { throwIfNoEntry: false })?.isDirectory()) {
      throw new BadFlags(`--recordings: no such folder (is ${options.recordings})`);
    }
    return options;
  } catch (error) {
    return fail(error.message, 2);
  }
}

function readProto(folder) {
  try {
    return loadProto(folder);
  } catch (error) {
    return fail(`--proto: ${error.message}`, 2);
  }
}

const options = readFlags();
if (options.help) {
  process.stdout.write(help);
  process.exit(0);
}
if (!fs.existsSync(`${dist}/index.html`)) fail('the page is not built: run "npm ci && npm run build" first', 1);

const root = readProto(options.proto);
const gateway = await startGateway({ ...options, root, dist }).catch((error) => fail(`--listen: ${error.message}`, 1));

let ending = false;
async function end() {
  if (ending) return;
  ending = true;
  await gateway.close();
  process.exit(0);
}
process.on('SIGINT', end);
process.on('SIGTERM', end);
if (options.exitWithStdin) process.stdin.on('end', end).on('close', end).on('error', end).resume();

console.log(`viewer: ${gateway.url}`);
