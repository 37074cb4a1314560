// One browser: streams to all regions for it, and what it asks for. Messages are described in README.md.
import { Inputs } from './inputs.js';
import { RegionLink } from './region_link.js';
import { BadRequest, pushOf, rayOf, removalOf, spawnOf } from './requests.js';
import { textOf } from './rpc.js';

const mostBuffered = 2 << 20;  // bytes on the way to the browser, above which the servers have to wait
const ask = 1000;              // ms between questions for a world that does not answer
const framesPerSecond = 20;

export const kinds = { frame: 1, status: 2, world: 3, layout: 4 };

export class Session {
  constructor({ socket, rpc, server }) {
    Object.assign(this, { socket, rpc, server });
    this.links = [];  // by region; null: it has left
    this.world = null;
    this.auras = false;
    this.ended = false;
    this.asking = false;
    this.waiting = new Set();  // for room
    this.endpointIndex = 0;
    this.inputs = new Inputs({
      rpc,
      endpoints: () => endpointsOf(this.world),
      settled: (outcome) => this.#tell({ type: 'outcome', ...outcome }),
    });
    socket.on('message', (data, binary) => this.#onMessage(data, binary));
    socket.on('close', () => this.close());
    socket.on('error', () => {});
    if (server !== '') this.#askWorld();
  }

  close() {
    if (this.ended) return;
    this.ended = true;
    clearTimeout(this.askTimer);
    clearInterval(this.roomTimer);
    for (const link of this.#open()) link.close();
    this.inputs.close();
    this.socket.terminate();
  }

  // ---- the world and its servers ----

  async #askWorld() {
    if (this.asking || this.ended) return;
    this.asking = true;
    // All that are known, in turn: one of them may be gone.
    const known = [this.server, ...endpointsOf(this.world)];
    const endpoint = known[this.endpointIndex++ % known.length];
    try {
      let world = await this.#getWorld(endpoint, this.world === null);
      // The scene is large: it is asked for when the world is another one.
      if (this.world !== null && this.#isOther(world.message)) world = await this.#getWorld(endpoint, true);
      if (!this.ended) this.#takeWorld(world);
    } catch (error) {
      this.#tell({ type: 'waiting', message: textOf(error) });
    }
    this.asking = false;
    this.#askLater();
  }

  async #getWorld(endpoint, scene) {
    const bytes = await this.rpc.call(endpoint, 'GetWorld', { scene }, 5);
    return { bytes, message: this.rpc.decode('GetWorldResponse', bytes) };
  }

  #askLater() {
    clearTimeout(this.askTimer);
    if (this.ended || (this.world !== null && this.#open().every((link) => link.up))) return;
    this.askTimer = setTimeout(() => this.#askWorld(), ask);
  }

  // Of another name, or begun anew where the one before has ended.
  #isOther(world) {
    if (world.name !== this.world.name) return true;
    return epochOf(world) < epochOf(this.world) && !this.#open().some((link) => link.up);
  }

  #takeWorld({ bytes, message }) {
    if (this.world !== null && !this.#isOther(message)) return this.#takeLayout(bytes, message);
    for (const link of this.#open()) link.close();
    this.links = [];
    this.world = message;
    this.#send(kinds.world, 0, bytes);
    this.#followLinks();
    return undefined;
  }

  // What servers that lag behind tell is older. The links of servers that stay stay.
  #takeLayout(bytes, world) {
    const change = epochOf(world) - epochOf(this.world);
    if (world.name !== this.world.name || change < 0) return;
    if (change === 0 && world.endpoints.join() === this.world.endpoints.join()) return;
    this.world = world;
    this.#send(kinds.layout, 0, bytes);
    this.#followLinks();
    this.inputs.follow();
  }

  #followLinks() {
    const { endpoints } = this.world;
    const before = this.links;
    this.links = endpoints.map((endpoint, region) => {
      if (endpoint === '') return null;
      return before[region]?.endpoint === endpoint ? before[region] : this.#link(endpoint, region);
    });
    for (const link of before) if (link !== null && !this.links.includes(link)) link.close();
  }

  #open() {
    return this.links.filter((link) => link !== null);
  }

  #link(endpoint, region) {
    return new RegionLink({
      rpc: this.rpc,
      endpoint,
      watch: { rate: framesPerSecond, velocities: true },
      auras: this.auras,
      outlet: { full: () => this.#full(), room: (fn) => this.#whenRoom(fn) },
      events: {
        frame: (bytes) => this.#send(kinds.frame, region, bytes),
        layout: (bytes) => {
          this.#send(kinds.status, region, bytes);
          // Field 1: the layout may have changed.
          if (bytes[0] === 0x0a) this.#takeLayout(firstField(bytes), this.rpc.decode('LayoutUpdate', bytes).world);
        },
        up: () => this.#tell({ type: 'link', region, up: true }),
        down: (message) => {
          this.#tell({ type: 'link', region, up: false, message });
          this.#askLater();
        },
      },
    });
  }

  // ---- to the browser ----

  #full() {
    return this.socket.bufferedAmount > mostBuffered;
  }

  // The socket does not say when it has drained, so it is looked at while somebody waits.
  #whenRoom(fn) {
    this.waiting.add(fn);
    this.roomTimer ??= setInterval(() => {
      if (this.#full()) return;
      clearInterval(this.roomTimer);
      this.roomTimer = null;
      const now = [...this.waiting];
      this.waiting.clear();
      for (const call of now) call();
    }, 50);
  }

  #send(kind, region, bytes) {
    if (this.ended || this.socket.readyState !== this.socket.OPEN) return;
    const head = Buffer.alloc(4);
    head.writeUInt8(kind, 0);
    head.writeUInt16LE(region, 2);
    this.socket.send(Buffer.concat([head, bytes]), { binary: true });
  }

  #tell(message) {
    if (this.ended || this.socket.readyState !== this.socket.OPEN) return;
    this.socket.send(JSON.stringify(message));
  }

  // ---- from the browser ----

  #onMessage(data, binary) {
    try {
      if (binary) this.#acknowledge(data);
      else this.#request(JSON.parse(data.toString()));
    } catch (error) {
      this.#tell({ type: 'error', message: error instanceof BadRequest ? error.message : 'not a message of this viewer' });
    }
  }

  // The kind, the region, and the tick of a frame that was read.
  #acknowledge(data) {
    if (data.length !== 12) throw new BadRequest('an acknowledgement of a wrong length');
    const tick = data.readDoubleLE(4);
    if (Number.isSafeInteger(tick) && tick >= 0) this.links[data.readUInt16LE(2)]?.acknowledge(tick);
  }

  #request(message) {
    if (typeof message !== 'object' || message === null) throw new BadRequest('not an object');
    if (message.type === 'push') return this.#push(message);
    if (message.type === 'spawn') return this.#spawn(message);
    if (message.type === 'remove') return this.#remove(message);
    if (message.type === 'ray') return this.#answer(message, this.#castRay(rayOf(message)));
    if (message.type === 'restart') return this.links.at(Number.isInteger(message.region) ? message.region : 0)?.restart();
    if (message.type === 'auras') {
      this.auras = message.on === true;
      for (const link of this.#open()) link.setAuras(this.auras);
      return undefined;
    }
    throw new BadRequest('type: no such message');
  }

  #push(message) {
    if (this.inputs.push(pushOf(message)) === 0) throw new BadRequest('too many pushes are on the way');
  }

  #spawn(message) {
    const request = spawnOf(message);
    const answer = this.inputs.call('SpawnBodies', request, request.bodies.length);
    this.#answer(message, answer.then(({ body, rejected }) => ({ bodies: body, rejected })));
  }

  #remove(message) {
    const request = removalOf(message);
    const answer = this.inputs.call('RemoveBodies', request, request.body.length);
    this.#answer(message, answer.then(({ removed, rejected }) => ({ removed: Number(removed), rejected })));
  }

  // Bodies may be on other servers than their place says, so all are asked.
  async #castRay(request) {
    const endpoints = endpointsOf(this.world);
    const answers = await Promise.all(endpoints.map((endpoint) => this.rpc.call(endpoint, 'CastRays', request, 2)));
    let nearest = null;
    for (const bytes of answers) {
      const hit = this.rpc.decode('CastRaysResponse', bytes).hits[0];
      if (hit && hit.body !== '0' && (nearest === null || hit.distance < nearest.distance)) nearest = hit;
    }
    return { hit: nearest };
  }

  #answer(message, promise) {
    const call = Number.isSafeInteger(message.call) ? message.call : 0;
    promise.then(
      (result) => this.#tell({ type: 'answer', call, ok: true, ...result }),
      (error) => this.#tell({ type: 'answer', call, ok: false, message: textOf(error) }),
    );
  }
}

const epochOf = (world) => Number(world.layout_epoch);

// Of the regions that have not left.
const endpointsOf = (world) => (world?.endpoints ?? []).filter((endpoint) => endpoint !== '');

// The bytes of the message that is field 1.
function firstField(bytes) {
  let length = 0, at = 1;
  for (let scale = 1; ; scale *= 128) {
    const byte = bytes[at++];
    length += (byte & 127) * scale;
    if (byte < 128) return bytes.subarray(at, at + length);
  }
}
