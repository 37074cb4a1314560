// Watches a whole Aureole world and plays with one body of it. The rules that this follows are the comments of
// proto/aureole/v1/simulation.proto.
import { randomBytes } from 'node:crypto';
import { EventEmitter, once } from 'node:events';
import { setTimeout as sleep } from 'node:timers/promises';
import { fileURLToPath } from 'node:url';
import { parseArgs } from 'node:util';
import grpc from '@grpc/grpc-js';
import protoLoader from '@grpc/proto-loader';

const USAGE = `usage: node watch.js --server HOST:PORT --spawn=X,Y,Z [--push=X,Y,Z] [--proto FOLDER]
       node watch.js --server HOST:PORT --watch SECONDS [--proto FOLDER]
  --spawn  where to put a sphere, m; with the "=", because a number may be negative
  --push   the impulse that it gets, N s; 300,0,0 when not given`;
const RADIUS = 0.5; // m
const MASS = 100; // kg
const PRECISION = 0.0005; // m: the bound of Precision.FINE
const CELL = 32; // m

// ---- vectors ----

const add = (a, b) => a.map((value, i) => value + b[i]);
const scale = (a, factor) => a.map((value) => value * factor);
const subtract = (a, b) => add(a, scale(b, -1));
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const length = (a) => Math.hypot(...a);
const vec3 = ([x, y, z]) => ({ x, y, z });
const round = (value) => Number(value.toFixed(5));
const array = ({ x, y, z }) => [x, y, z];

// ---- the merged state ----

// Ids come as differences, as strings. They need all of 64 bits, so they stay BigInt.
function ids(column) {
  let id = 0n;
  return column.map((difference) => (id += BigInt(difference)));
}

const three = (column, i) => column.slice(3 * i, 3 * i + 3);
const newer = (a, b) => (!a || (b && b.epoch > a.epoch) ? b : a);

// What the streams of all regions tell, as one world.
class Merged {
  constructor(regions) {
    // Per region: the tick of its newest complete frame, and what it tells of its bodies, by id.
    this.regions = new Map(regions.map((region) => [region, { tick: 0, frame: '0', bodies: new Map() }]));
    this.moves = new Map(); // bodies on their way: a region has told where they went, the other one not yet of them
    this.removed = new Map(); // the tick of it; until all regions are past it, one may still tell of the body
    this.descriptions = new Map();
  }

  read(frame) {
    const region = this.regions.get(frame.region);
    const tick = Number(frame.tick);
    if (frame.base_tick === '0') region.bodies.clear();
    else if (frame.base_tick !== region.frame) throw new Error(`region ${frame.region}: a frame was lost`);
    for (const described of frame.described) {
      for (const id of ids(described.body)) this.descriptions.set(id, described);
    }
    for (const cell of frame.cells) this.readCell(region, cell, tick);
    for (let i = 0; i < frame.dropped.length; i += 2) {
      for (const [id, body] of region.bodies) {
        if (body.x === frame.dropped[i] && body.z === frame.dropped[i + 1]) region.bodies.delete(id);
      }
    }
    ids(frame.passed).forEach((id, i) => {
      this.move(region, id, frame.passed_region[i], frame.passed_epoch[i], tick + frame.passed_tick[i]);
    });
    region.frame = frame.tick;
    if (!frame.more) region.tick = tick;
    this.settle();
  }

  readCell(region, cell, tick) {
    const { bodies } = region;
    ids(cell.id).forEach((id, i) => {
      const body = bodies.get(id);
      if (!body) throw new Error(`a change of body ${id}, which was never told`);
      body.position = add(body.position, three(cell.position, i));
      body.orientation = add(body.orientation, three(cell.orientation, i));
    });
    let moved = 0;
    ids(cell.gone).forEach((id, i) => {
      const body = bodies.get(id);
      const why = cell.why[i];
      if (why === 0) {
        // It may be in another cell of this region already.
        if (body && body.x === cell.x && body.z === cell.z) bodies.delete(id);
      } else if (why === 1) {
        bodies.delete(id);
        this.moves.delete(id);
        this.descriptions.delete(id);
        this.removed.set(id, tick);
      } else {
        this.move(region, id, why - 2, cell.moved_epoch[moved], tick + cell.moved_tick[moved]);
        moved += 1;
      }
    });
    ids(cell.new_id).forEach((id, i) => {
      bodies.set(id, {
        epoch: cell.new_epoch[i],
        x: cell.x,
        z: cell.z,
        position: three(cell.new_position, i),
        orientation: three(cell.new_orientation, i),
        largest: cell.new_largest[i],
        asleep: false,
      });
    });
    for (const [column, asleep] of [[cell.slept, true], [cell.woke, false]]) {
      for (const id of ids(column)) {
        if (bodies.has(id)) bodies.get(id).asleep = asleep;
      }
    }
  }

  // `from` tells that the body belongs to region `to` from a tick on: show it as it was until that region tells of it.
  move(from, id, to, epoch, tick) {
    let last = from.bodies.get(id);
    if (last && last.epoch >= epoch) last = undefined; // it is back already
    if (last) {
      last.tick = from.tick;
      from.bodies.delete(id);
    }
    const known = this.moves.get(id);
    last = newer(last, known?.last);
    if (known && known.epoch > epoch) known.last = last;
    else this.moves.set(id, { to, epoch, tick, last });
  }

  // Forgets what all have caught up with.
  settle() {
    for (const [id, { to, tick }] of this.moves) {
      if (this.regions.get(to).tick < tick) continue;
      this.moves.delete(id);
      if (!this.find(id)) this.descriptions.delete(id); // removed on its way
    }
    for (const [id, tick] of this.removed) {
      if (this.tick() >= tick) this.removed.delete(id);
    }
  }

  // The last tick that all regions have told; 0 until all have.
  tick() {
    return Math.min(...[...this.regions.values()].map((region) => region.tick));
  }

  // Where two regions tell of a body, the one with the higher epoch is right.
  find(id) {
    if (this.removed.has(id)) return undefined;
    let found = this.moves.get(id)?.last;
    for (const region of this.regions.values()) {
      const body = region.bodies.get(id);
      if (body && (!found || body.epoch > found.epoch)) found = { ...body, tick: region.tick };
    }
    return found && { ...found, ...pose(found) };
  }

  all() {
    const every = new Set(this.moves.keys());
    for (const { bodies } of this.regions.values()) for (const id of bodies.keys()) every.add(id);
    return [...every].map((id) => this.find(id)).filter((body) => body);
  }
}

// Metres and a quaternion x, y, z, w from the integers of Precision.FINE.
function pose({ x, z, position, orientation, largest }) {
  const small = scale(orientation, 1 / 4096);
  const root = Math.sqrt(Math.max(0, 1 - dot(small, small)));
  return {
    position: add(scale(position, 1 / 2048), [CELL * x, 0, CELL * z]),
    orientation: [...small.slice(0, largest), root, ...small.slice(largest)],
  };
}

// ---- the servers ----

// The interface. `frames` counts what comes in, because a decoded frame no longer knows its length.
function load(proto, frames) {
  const types = protoLoader.loadSync('aureole/v1/simulation.proto', {
    includeDirs: [proto], keepCase: true, longs: String, enums: String, defaults: true, json: true,
  });
  const stream = types['aureole.v1.Simulation'].StreamReplicas;
  const decode = stream.responseDeserialize;
  stream.responseDeserialize = (bytes) => {
    frames.count += 1;
    frames.bytes += bytes.length;
    return decode(bytes);
  };
  const { Simulation } = grpc.loadPackageDefinition(types).aureole.v1;
  const ErrorStatus = types['aureole.v1.ErrorStatus'];
  return {
    connect: (endpoint) => new Simulation(endpoint, grpc.credentials.createInsecure()),
    // What a server says of a refusal: reason, field and remedy.
    explain(error) {
      const [bytes] = error.metadata?.get('grpc-status-details-bin') ?? [];
      if (!bytes) return error.message;
      const [{ reason, field, remedy }] = ErrorStatus.deserialize(bytes).details;
      return `${error.message}\n  reason: ${reason}\n  field: ${field || '(none)'}\n  remedy: ${remedy}`;
    },
  };
}

// One call with one answer. Without a request it is a stream of requests: `send` writes them.
function call(client, method, request, send) {
  return new Promise((resolve, reject) => {
    const done = (error, response) => (error ? reject(error) : resolve(response));
    const options = { deadline: Date.now() + 10_000 };
    if (request) {
      client[method](request, options, done);
    } else {
      const stream = client[method](options, done);
      stream.write(send);
      stream.end();
    }
  });
}

// The merged streams of all servers. `until` waits for something to be true of them.
class World {
  constructor({ connect }, { endpoints, layout_epoch }, frames) {
    this.frames = frames;
    const there = [...endpoints.keys()].filter((region) => endpoints[region] !== ''); // others have left
    this.merged = new Merged(there);
    this.clients = there.map((region) => connect(endpoints[region]));
    this.news = new EventEmitter();
    for (const client of this.clients) {
      const stream = client.StreamReplicas({});
      stream.on('error', (error) => this.fail(error));
      stream.on('end', () => this.fail(new Error('a stream ended')));
      stream.on('data', (frame) => {
        try {
          if (frame.layout_epoch !== layout_epoch) throw new Error('the layout has changed');
          this.merged.read(frame);
          this.news.emit('frame');
        } catch (error) {
          this.fail(error);
        }
      });
    }
  }

  fail(error) {
    this.failure ??= error;
    this.news.emit('frame');
  }

  async until(what, condition) {
    const signal = AbortSignal.timeout(20_000);
    for (;;) {
      if (this.failure) throw this.failure;
      const value = condition();
      if (value) return value;
      await once(this.news, 'frame', { signal }).catch(() => {
        throw new Error(`waited for 20 s until ${what}`);
      });
    }
  }
}

// ---- what to do ----

async function watchFor(world, seconds) {
  for (let second = 0; second < seconds; second += 1) {
    world.frames.count = 0;
    world.frames.bytes = 0;
    await sleep(1000);
    if (world.failure) throw world.failure;
    const bodies = world.merged.all();
    const asleep = bodies.filter((body) => body.asleep).length;
    const { count, bytes } = world.frames;
    console.log(JSON.stringify({ tick: world.merged.tick(), bodies: bodies.length, asleep, frames: count, bytes }));
  }
}

// Casts a ray from behind the body along its way, so that it is on the ray however far it has come meanwhile.
async function castOnto(world, id) {
  for (let attempt = 0; attempt < 20; attempt += 1) {
    const before = await world.until('the sphere is seen', () => world.merged.find(id));
    const now = await world.until('the sphere goes on', () => {
      const body = world.merged.find(id);
      return body && body.tick > before.tick && body;
    });
    const way = subtract(now.position, before.position);
    const direction = length(way) > 0.001 ? scale(way, 1 / length(way)) : [0, -1, 0];
    const ray = { origin: vec3(subtract(now.position, scale(direction, 2))), direction: vec3(direction), length: 10 };
    const answers = await Promise.all(world.clients.map((client) => call(client, 'CastRays', { rays: [ray] })));
    const [nearest] = answers
      .map(({ tick, hits: [hit] }) => ({ ...hit, tick: Number(tick) }))
      .filter((hit) => hit.body !== '0')
      .sort((a, b) => a.distance - b.distance);
    if (nearest && BigInt(nearest.body) === id) return { hit: nearest, now, step: length(way) };
  }
  throw new Error('other bodies are in the way of all rays');
}

// What was refused of a call that went on is a surprise here.
function accepted(answer) {
  if (answer.rejected.length > 0) throw new Error(`rejected: ${JSON.stringify(answer.rejected)}`);
  return answer;
}

async function play(world, at, push) {
  const { merged, clients: [server] } = world;
  const client = (randomBytes(8).readBigUInt64BE() | 1n).toString(); // any number but 0

  const sphere = { shape: { sphere: { radius: RADIUS } }, mass: MASS, position: vec3(at) };
  const spawned = accepted(await call(server, 'SpawnBodies', { client, sequence: 1, bodies: [sphere] }));
  const id = BigInt(spawned.body[0]);
  const start = await world.until('the sphere is seen', () => merged.find(id));
  if (Math.abs(merged.descriptions.get(id)?.shape.sphere?.radius - RADIUS) > 1e-6) {
    throw new Error(`the body that came is no such sphere: ${JSON.stringify(merged.descriptions.get(id))}`);
  }

  const impulse = [{ sequence: 2, body: id.toString(), impulse: vec3(push) }];
  const pushed = accepted(await call(server, 'ApplyImpulses', undefined, { client, impulse }));
  await world.until('the sphere moves; is something in its way?', () => {
    const body = merged.find(id);
    return body && body.tick >= Number(pushed.last_tick)
      && dot(subtract(body.position, start.position), push) > 0.1 * length(push);
  });

  const { hit, now, step } = await castOnto(world, id);
  const after = await world.until('the tick of the hit is seen', () => {
    const body = merged.find(id);
    return body && body.tick >= hit.tick && body;
  });
  // The hit is on the surface, at a tick between those of `now` and `after`: where the sphere then was, is estimated.
  const way = subtract(after.position, now.position);
  const then = add(now.position, scale(way, (hit.tick - now.tick) / (after.tick - now.tick || 1)));
  const off = Math.abs(length(subtract(array(hit.point), then)) - RADIUS);
  const meanwhile = [now.tick, after.tick].includes(hit.tick) ? 0 : step + length(way);
  if (off > PRECISION + meanwhile) {
    throw new Error(`the hit is ${off} m off the sphere, which has moved by ${meanwhile} m meanwhile`);
  }

  const end = merged.find(id);
  const bodies = merged.all().length;
  const gone = accepted(await call(server, 'RemoveBodies', { client, sequence: 3, body: [id.toString()] }));
  await world.until('the sphere is gone', () => merged.tick() >= Number(gone.tick) && !merged.find(id));

  console.log(JSON.stringify({
    tick: merged.tick(),
    bodies,
    spawned: id.toString(), // a number of JSON would lose digits
    moved: round(length(subtract(end.position, start.position))),
    position: end.position.map(round),
    orientation: end.orientation.map(round), // x, y, z, w
    hit_distance: round(hit.distance),
    hit_off: round(off),
    outcomes: {
      spawned: spawned.body.length,
      applied: Number(pushed.applied),
      removed: Number(gone.removed),
    },
  }));
}

function readArguments() {
  const vector = (text) => {
    const numbers = text.split(',').map((part) => (part.trim() ? Number(part) : NaN));
    if (numbers.length !== 3 || !numbers.every(Number.isFinite)) throw new Error(`not X,Y,Z: ${text}`);
    return numbers;
  };
  const { values } = parseArgs({
    options: {
      server: { type: 'string' },
      spawn: { type: 'string' },
      push: { type: 'string', default: '300,0,0' },
      watch: { type: 'string' },
      proto: { type: 'string', default: fileURLToPath(new URL('../../../proto', import.meta.url)) },
    },
  });
  if (!values.server) throw new Error('--server is missing');
  if ((values.spawn === undefined) === (values.watch === undefined)) throw new Error('one of --spawn and --watch');
  const seconds = Number(values.watch ?? 1);
  if (!(Number.isInteger(seconds) && seconds > 0)) throw new Error(`not a number of seconds: ${values.watch}`);
  const push = vector(values.push);
  if (length(push) === 0) throw new Error('--push must not be 0');
  return { ...values, spawn: values.spawn && vector(values.spawn), push, seconds };
}

async function main({ server, spawn, push, watch, seconds, proto }) {
  const frames = { count: 0, bytes: 0 };
  let api;
  try {
    api = load(proto, frames);
    const world = new World(api, await call(api.connect(server), 'GetWorld', {}), frames);
    await world.until('all regions are seen', () => world.merged.tick() > 0);
    if (watch) await watchFor(world, seconds);
    else await play(world, spawn, push);
    return 0;
  } catch (error) {
    console.error(`watch.js: ${api?.explain(error) ?? error.message}`);
    return 1;
  }
}

let options;
try {
  options = readArguments();
} catch (error) {
  console.error(`watch.js: ${error.message}\n${USAGE}`);
  process.exit(2);
}
process.exit(await main(options));
