// The world as it was told: a decoder per region, merged. Live streams and recordings feed it alike.
import { ReplicaDecoder } from './decode.js';
import { ReplicaMerger } from './merge.js';

const trafficWindow = 2000;  // ms

class RegionStream {
  constructor() {
    this.decoder = new ReplicaDecoder();
    this.complete = false;  // all that is in view has been told
    this.tick = 0;
    this.realTimeFactor = 1;
    this.up = false;
    this.status = null;  // RegionStatus
    this.frames = 0;
    this.bytes = 0;
  }
  clone() {
    return Object.assign(new RegionStream(), this, { decoder: this.decoder.clone() });
  }
}

export class Model {
  // `listener`: changed(body, regionBefore or -1), lost(body), reset().
  constructor(listener) {
    this.listener = listener;
    this.world = null;  // GetWorldResponse
    this.clear();
  }

  // Forgets all but the world.
  clear() {
    this.merger = new ReplicaMerger();
    this.owners = new Map();  // id -> region as the listener knows it
    this.looks = new Map();   // id -> BodyDescription
    this.streams = [];
    this.newest = 0;  // tick
    this.period = 0;  // ticks between frames, as of late
    if (this.world !== null) this.merger.follow(Number(this.world.layout_epoch), this.members);
    this.listener.reset();
  }

  get bodies() {
    return this.merger.bodies;
  }
  get tickSeconds() {
    return (this.world?.tick_us || 16000) * 1e-6;
  }
  get complete() {
    return this.members.length > 0 && this.members.every((region) => this.streams[region]?.complete);
  }
  get regions() {
    return this.world?.layout.length ?? 0;
  }
  // The regions that have not left.
  get members() {
    const endpoints = this.world?.endpoints ?? [];
    return [...endpoints.keys()].filter((region) => endpoints[region] !== '');
  }

  // null: none.
  setWorld(world) {
    this.world = world;
    this.clear();
    for (const region of this.members) this.stream(region);
  }

  // Of the same world, without its scene: servers have come or gone, or are elsewhere.
  setLayout(world) {
    this.world = { ...world, scene: this.world.scene };
    const { members } = this;
    for (const region of this.streams.keys()) if (!members.includes(region)) delete this.streams[region];
    for (const region of members) this.stream(region);
    this.merger.follow(Number(world.layout_epoch), members);
  }

  stream(region) {
    return (this.streams[region] ??= new RegionStream());
  }

  // A new stream to this region begins; what the old one told stays until the new one is complete.
  beginStream(region) {
    const stream = this.stream(region);
    stream.decoder = new ReplicaDecoder();
    stream.complete = false;
    stream.up = true;
  }

  // Throws when the frame does not follow the last one.
  takeFrame(region, frame, bytes) {
    const stream = this.stream(region);
    stream.decoder.apply(frame);
    for (const d of frame.described) this.#describe(d);
    this.merger.apply(region, stream.decoder, frame);
    this.#tellListener();
    stream.complete ||= !frame.more;
    stream.tick = frame.tick;
    stream.realTimeFactor = frame.real_time_factor;
    ++stream.frames;
    stream.bytes += bytes;
    if (frame.base_tick > 0) {
      const period = frame.tick - frame.base_tick;
      this.period = this.period === 0 ? period : this.period + 0.1 * (period - this.period);
    }
    this.newest = Math.max(this.newest, frame.tick);
  }

  // Simulated per wall time, of the slowest server.
  realTimeFactor() {
    let least = Infinity;
    for (const s of this.streams) if (s?.complete) least = Math.min(least, s.realTimeFactor);
    return least === Infinity ? 1 : least;
  }

  counts() {
    let asleep = 0;
    for (const body of this.bodies.values()) if (body.state.asleep) ++asleep;
    return { bodies: this.bodies.size, asleep };
  }

  // All that frames have made, to come back to.
  checkpoint() {
    return {
      merger: this.merger.clone(), looks: new Map(this.looks), streams: this.streams.map((s) => s.clone()),
      newest: this.newest, period: this.period,
    };
  }

  restore(checkpoint) {
    this.merger = checkpoint.merger.clone();
    this.looks = new Map(checkpoint.looks);
    this.streams = checkpoint.streams.map((s) => s.clone());
    this.newest = checkpoint.newest;
    this.period = checkpoint.period;
    this.owners = new Map();
    this.listener.reset();
    for (const body of this.bodies.values()) {
      this.owners.set(body.id, body.region);
      this.listener.changed(body, -1);
    }
  }

  #describe(description) {
    let id = 0n;
    for (const step of description.body) this.looks.set((id += step), description);
  }

  #tellListener() {
    for (const body of this.merger.changed) {
      // It may have been lost later in the same frame.
      if (this.bodies.get(body.id) !== body) continue;
      const before = this.owners.get(body.id) ?? -1;
      this.owners.set(body.id, body.region);
      this.listener.changed(body, before);
    }
    for (const body of this.merger.lost) {
      this.owners.delete(body.id);
      this.looks.delete(body.id);
      this.listener.lost(body);
    }
  }
}

// Bytes per second over the last while, from a count that grows.
export class Rate {
  constructor() {
    this.samples = [];
  }
  add(now, total) {
    this.samples.push([now, total]);
    while (this.samples.length > 2 && this.samples[1][0] < now - trafficWindow) this.samples.shift();
  }
  perSecond() {
    if (this.samples.length < 2) return 0;
    const [a, b] = [this.samples[0], this.samples.at(-1)];
    return b[0] > a[0] ? ((b[1] - a[1]) * 1000) / (b[0] - a[0]) : 0;
  }
}
