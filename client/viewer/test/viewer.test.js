// The viewer as people use it: a running world, the gateway, and a browser that draws in software.
import assert from 'node:assert/strict';
import { execFile } from 'node:child_process';
import fs from 'node:fs';
import os from 'node:os';
import path from 'node:path';
import { after, before, describe, test } from 'node:test';
import { fileURLToPath } from 'node:url';
import { promisify } from 'node:util';
import { McapIndexedReader } from '@mcap/core';
import { chromium } from 'playwright-core';
import protobuf from 'protobufjs';
import descriptor from 'protobufjs/ext/descriptor/index.js';
import { Rpc } from '../gateway/rpc.js';
import { regionColour } from '../src/palette.js';
import { messages, root } from './frames.js';
import { findChromium, startUntil, startWorld, stop } from './processes.js';
import { readableFile, recordWorld } from './record.js';
import { asleepAtStart, bodiesAtStart, testWorld } from './world.js';

const here = path.dirname(fileURLToPath(import.meta.url));
const bin = process.env.AUREOLE_BIN ?? path.join(here, '../../../build/release/bin');
const screenshots = process.env.AUREOLE_SCREENSHOTS ?? '';
const leastFramesPerSecond = 10;
const longestHighlightMs = 300;
const software = ['--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--no-sandbox'];

const folder = fs.mkdtempSync(path.join(os.tmpdir(), 'aureole-viewer-'));
let world, gateway, browser, page, url, rpc;

// Asks the page until it says something else than null or false.
async function until(what, fn, ...args) {
  try {
    return await (await page.waitForFunction(fn, args, { timeout: 15_000, polling: 30 })).jsonValue();
  } catch (error) {
    throw new Error(`${what} did not happen: ${error.message}`);
  }
}

const ask = (fn, ...args) => page.evaluate(fn, args);

async function takePicture(name) {
  if (screenshots !== '') await page.screenshot({ path: path.join(screenshots, `${name}.png`) });
}

// Of all servers, at one tick: while they answer for different ones, a body that moves on may count twice or not at all.
async function ownedBodies() {
  for (const end = Date.now() + 15_000; Date.now() < end; ) {
    const bytes = await Promise.all(world.servers.map((server) => rpc.call(server, 'GetWorld', {}, 5)));
    const answers = bytes.map((answer) => messages.decode('GetWorldResponse', answer));
    if (answers.every(({ tick }) => tick === answers[0].tick)) return answers.reduce((sum, { bodies }) => sum + bodies, 0);
  }
  throw new Error('the servers never answered for one tick');
}

// Adds a ball and waits until it is seen. Returns its id.
async function addBall(position, velocity = [0, 0, 0], radius = 0.5) {
  const [id] = await ask(([body]) => window.aureole.spawn({ bodies: [body] }), { shape: { sphere: { radius } }, position, velocity });
  await until('the new body', ([body]) => window.aureole.body(body) !== null, id);
  return id;
}

const lookAt = (target, distance, pitch = 0.5) =>
  ask(([t, d, p]) => window.aureole.look(t, d, 0.6, p), target, distance, pitch);

// Clicks where a body is drawn, once the picture shows it there.
async function clickBody(id) {
  const place = await until('the body under the pointer', ([body]) => {
    const at = window.aureole.screen(body);
    return at !== null && window.aureole.at(at.x, at.y) === body ? at : null;
  }, id);
  await page.mouse.click(place.x, place.y);
}

before(async () => {
  const executablePath = findChromium();
  assert.ok(executablePath, 'chromium is not installed: apt-get install chromium');
  const worldFile = path.join(folder, 'world.json');
  fs.writeFileSync(worldFile, JSON.stringify(testWorld()));
  world = await startWorld(bin, worldFile);
  const started = await startUntil(process.execPath,
    [path.join(here, '../gateway.js'), '--server', world.servers[0], '--recordings', folder, '--exit-with-stdin'], /viewer: (http\S+)/);
  gateway = started.child;
  url = started.match[1];
  rpc = new Rpc(root);
  browser = await chromium.launch({ executablePath, args: software });
  page = await browser.newPage({ viewport: { width: 1280, height: 720 } });
  page.on('pageerror', (error) => console.error(`page: ${error.stack}`));
  page.on('console', (message) => message.type() === 'error' && console.error(`page: ${message.text()}`));
  await page.goto(url);
}, { timeout: 60_000 });

after(async () => {
  await browser?.close();
  rpc?.close();
  await Promise.all([stop(gateway), stop(world?.child)]);
  fs.rmSync(folder, { recursive: true });
});

describe('a live world of 2,000 bodies on four regions', { concurrency: false }, () => {
  test('ItsBodiesAreCounted', async () => {
    await until('the world', () => window.aureole?.ready());
    const counts = await ask(() => window.aureole.counts());
    assert.deepEqual([counts.bodies, counts.drawn, counts.regions], [bodiesAtStart, bodiesAtStart, 4]);
    assert.equal(await ownedBodies(), bodiesAtStart);
  });

  test('ItIsDrawnAtTenFramesPerSecondAtLeast', async (t) => {
    // While half of the bodies move.
    const measured = await until('forty pictures', () => {
      const now = performance.now(), frames = window.aureole.frames();
      window.measureFrom ??= { now, frames };
      const { now: from, frames: first } = window.measureFrom;
      return frames - first >= 40 && { framesPerSecond: ((frames - first) * 1000) / (now - from), counts: window.aureole.counts() };
    });
    t.diagnostic(`${measured.framesPerSecond.toFixed(1)} frames/s, ${measured.counts.asleep} of ${measured.counts.bodies} asleep`);
    await takePicture('live');
    assert.ok(measured.counts.asleep <= 1.1 * asleepAtStart, `${measured.counts.asleep} asleep`);
    assert.ok(measured.framesPerSecond >= leastFramesPerSecond, `${measured.framesPerSecond} frames/s`);
  });

  test('AClickHighlightsWithin300ms', async (t) => {
    const id = await addBall([-50, 0.5, -50]);
    await lookAt([-50, 0.5, -50], 12);
    await clickBody(id);
    const ms = await until('the highlight', () => window.aureole.highlightMs());
    t.diagnostic(`${ms.toFixed(0)} ms from the click to the picture`);
    assert.equal(await ask(() => window.aureole.selected()), id);
    assert.deepEqual(await ask(([body]) => window.aureole.body(body).colour, id), [1, 1, 1]);
    assert.equal(await page.textContent('#body-id'), `body ${id}`);
    assert.match(await page.textContent('#body-rows'), /sphere, radius 0.5 m/);
    await takePicture('selected');
    assert.ok(ms <= longestHighlightMs, `${ms} ms`);
    await page.keyboard.press('Escape');
    assert.equal(await ask(() => window.aureole.selected()), null);
  });

  test('ColoursFollowOwnership', async () => {
    const id = await addBall([-3, 0.5, -60], [5, 0, 0]);
    const seen = (region) => until(`region ${region}`, ([body, owner]) => {
      const now = window.aureole.body(body);
      return now !== null && now.region === owner && now;
    }, id, region);
    const [west, east] = [await seen(0), await seen(1)];
    assert.ok(east.epoch > west.epoch);
    for (const { region, colour } of [west, east]) {
      regionColour(region).forEach((c, i) => assert.ok(Math.abs(colour[i] - c) < 0.01, `${colour} of region ${region}`));
    }
  });

  test('AClickWithThePushToolPushesTheBodyUnderThePointer', async () => {
    const id = await addBall([50, 0.5, 50]);
    await lookAt([50, 0.5, 50], 12, 0.2);
    const from = await ask(([body]) => window.aureole.body(body).position, id);
    await page.keyboard.press('2');
    await clickBody(id);
    const outcome = await until('the outcome', () => window.aureole.outcomes().at(-1) ?? null);
    assert.deepEqual([outcome.reason, outcome.bodies], ['', 1]);
    // Away from the camera, which looks from +x and +z.
    const to = await until('the push', ([body, [x, , z]]) => {
      const { position } = window.aureole.body(body);
      return position[0] < x - 1 && position[2] < z - 1 && position;
    }, id, from);
    assert.ok(Math.hypot(to[0] - from[0], to[2] - from[2]) > 1.4);
  });

  test('ADragWithThePushToolThrowsTheBody', async () => {
    const id = await addBall([50, 0.5, -50]);
    await lookAt([50, 0.5, -50], 12, 0.2);
    const place = await until('the body under the pointer', ([body]) => {
      const at = window.aureole.screen(body);
      return at !== null && window.aureole.at(at.x, at.y) === body ? at : null;
    }, id);
    await page.mouse.move(place.x, place.y);
    await page.mouse.down();
    await page.mouse.move(place.x, place.y - 200, { steps: 4 });
    await page.mouse.up();
    await until('the throw', ([body]) => window.aureole.body(body).position[1] > 1.5, id);
    await page.keyboard.press('1');
  });

  test('TheSpawnToolDropsABodyWhereOneClicks', async () => {
    await lookAt([-50, 0, 50], 15);
    const known = new Set(await ask(() => window.aureole.ids()));
    await page.keyboard.press('3');
    await page.mouse.click(640, 360);
    const ids = await until('the new body', ([n]) => window.aureole.ids().length > n && window.aureole.ids(), known.size);
    await page.keyboard.press('1');
    const [x, , z] = await ask(([body]) => window.aureole.body(body).position, ids.find((id) => !known.has(id)));
    assert.ok(Math.hypot(x + 50, z - 50) < 1, `${x}, ${z}`);
  });

  test('TheCountStillEqualsTheServers', async () => {
    const sum = await ownedBodies();
    await until('the same count', ([n]) => window.aureole.counts().bodies === n, sum);
  });
});

describe('a recording', { concurrency: false }, () => {
  test('OtherToolsReadWhatAureoleRecords', async () => {
    const file = path.join(folder, 'other.mcap');
    await recordWorld(bin, world.servers[0], file, 1);
    const reader = await McapIndexedReader.Initialize({ readable: await readableFile(file) });
    assert.ok(reader.chunkIndexes.length > 0);
    const topics = new Set([...reader.channelsById.values()].map(({ topic }) => topic));
    for (const topic of ['/world', '/region/0/snapshot', '/region/3/hashes', '/region/2/frames', '/region/1/status']) {
      assert.ok(topics.has(topic), topic);
    }
    for (const schema of reader.schemasById.values()) {
      const files = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
      assert.ok(files.lookupType(schema.name), schema.name);
    }
    let count = 0n, last = 0n;
    for await (const { channelId, logTime, data } of reader.readMessages()) {
      assert.ok(logTime >= last, 'in order of time');
      last = logTime;
      ++count;
      if (reader.channelsById.get(channelId).topic !== '/region/2/frames') continue;
      assert.equal(messages.decode('ReplicaFrame', data).region, 2);
    }
    assert.equal(count, reader.statistics.messageCount);
  });
  test('ItPlaysAndScrubsBackToTheFirstState', async () => {
    await recordWorld(bin, world.servers[1], path.join(folder, 'run.mcap'), 3);
    await page.goto(`${url}?recording=run.mcap`);
    await until('the recording', () => window.aureole?.ready() && window.aureole.span() !== null);
    const { bodies } = await ask(() => window.aureole.counts());
    assert.ok(bodies >= bodiesAtStart, `${bodies} bodies`);
    const first = await shownAtStart();
    await page.keyboard.press('Space');
    await until('another tick', ([tick]) => window.aureole.tick() > tick + 60, first.tick);
    await takePicture('recording');
    const later = await shown();
    const movedBy = first.bodies.map(([id, x, y, z]) => {
      const now = later.bodies.find(([other]) => other === id);
      return now === undefined ? 0 : Math.hypot(now[1] - x, now[2] - y, now[3] - z);
    });
    assert.ok(movedBy.filter((d) => d > 0.05).length > 100, 'hardly anything moves');
    assert.deepEqual(await shownAtStart(), first);
  });
});

describe('servers that come and go', () => {
  test('ThePageFollowsThemAndMissesNoBody', async () => {
    await page.goto(url);
    await until('the world', () => window.aureole?.ready());
    const { bodies } = await ask(() => window.aureole.counts());
    await ask(() => {
      window.seen = [];
      setInterval(() => window.seen.push(window.aureole.counts().bodies), 20);
    });
    for (const [columns, rows] of [[3, 2], [2, 1]]) {
      const args = ['resize', '--control', world.control, '--columns', columns, '--rows', rows].map(String);
      await promisify(execFile)(path.join(bin, 'aureole'), args);
      await until(`${columns} times ${rows} regions`, ([regions]) => {
        const owners = new Set(window.aureole.ids().map((id) => window.aureole.body(id)?.region));
        const members = window.aureole.members();
        return members.length === regions && window.aureole.ready() && window.aureole.connected()
          && owners.size === regions && members.every((region) => owners.has(region));
      }, columns * rows);
      assert.equal(await ask(() => [...document.querySelectorAll('#regions li')].filter((item) => !item.hidden).length),
        columns * rows);
      await takePicture(`regions-${columns * rows}`);
    }
    const seen = await ask(() => window.seen);
    assert.ok(seen.length > 20);
    assert.deepEqual([Math.min(...seen), Math.max(...seen)], [bodies, bodies]);
    // Inputs go to a server that is there.
    await addBall([0, 30, 0]);
  });
});

describe('a world that has ended', () => {
  test('ThePageSaysSoAndKeepsTrying', async () => {
    await page.goto(url);
    await until('the world', () => window.aureole?.ready());
    await stop(world.child);
    await until('the message', () => /connection lost to all regions, trying again/.test(document.getElementById('banner').textContent));
    assert.equal(await page.textContent('#mode'), 'connection lost');
    assert.ok((await ask(() => window.aureole.counts())).bodies >= bodiesAtStart);
  });
});

// The tick and where all bodies are drawn.
function shown() {
  return ask(() => ({
    tick: window.aureole.tick(),
    bodies: window.aureole.ids().map((id) => [id, ...window.aureole.body(id).shown]).sort((a, b) => (a[0] < b[0] ? -1 : 1)),
  }));
}

// Paused at the first tick.
async function shownAtStart() {
  await ask(() => {
    window.aureole.pause();
    window.aureole.seek(window.aureole.span()[0]);
  });
  await until('the first tick', () => window.aureole.tick() === window.aureole.span()[0] && !window.aureole.seeking());
  return shown();
}
