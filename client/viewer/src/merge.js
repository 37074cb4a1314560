// One world from the streams of all its servers: each body once, by its epoch, however its servers' frames overtake each
// other. The rule is at Cell.moved_tick in proto/aureole/v1/simulation.proto.
import { moved, removed } from './decode.js';

const statesKept = 4;

// A merged body: { id, region (whose stream told it), tick (when its state was told or, at rest, last changed), state,
// before: [{ tick, state }, ...] }. `before` has earlier states, the latest first, each with the last tick at which it is
// known to have held. States are never changed, only replaced.
export class ReplicaMerger {
  constructor() {
    this.bodies = new Map();
    // Bodies that their server handed over and whose new server has not told them yet: they stay as they were.
    this.transits = new Map();
    this.ticks = new Map();  // of each region's last frame
    // Bodies that were removed, and when: a frame of another region that comes late may still tell of them.
    this.removed = new Map();
    this.changed = [];       // of the last call: bodies
    this.lost = [];          // of the last call: bodies that are gone from the merged world
  }

  clone() {
    const out = new ReplicaMerger();
    out.bodies = new Map([...this.bodies].map(([id, body]) => [id, { ...body, before: body.before.slice() }]));
    out.transits = new Map([...this.transits].map(([id, t]) => [id, { ...t }]));
    out.ticks = new Map(this.ticks);
    out.removed = new Map(this.removed);
    return out;
  }

  // After `decoder`, of this region's stream, has taken a frame. `more`: that frame did not hold all that is in view.
  apply(region, decoder, more = false) {
    this.changed = [];
    this.lost = [];
    for (const id of decoder.changed) if (decoder.has(id) && !this.removed.has(id)) this.#take(region, decoder, id);
    for (const lost of decoder.lost) {
      if (lost.why === removed) this.removed.set(lost.id, decoder.tick);
      this.#handOver(region, lost);
    }
    this.ticks.set(region, decoder.tick);
    if (!more) {
      for (const [id, t] of this.transits) {
        if (t.region === region && decoder.tick >= t.tick && !decoder.has(id)) this.#lose(id);
      }
    }
    const oldest = Math.min(...this.ticks.values());
    for (const [id, tick] of this.removed) if (tick < oldest) this.removed.delete(id);
  }

  // After a new stream to this region has told all that is in view: what the old one told and the new one does not have
  // is gone.
  reconcile(region, decoder) {
    this.changed = [];
    this.lost = [];
    for (const [id, body] of this.bodies) {
      if (body.region === region && !this.transits.has(id) && !decoder.has(id)) this.#lose(id);
    }
  }

  #take(region, decoder, id) {
    const state = decoder.get(id);
    let body = this.bodies.get(id);
    if (body === undefined) {
      this.bodies.set(id, (body = { id, region, tick: decoder.tick, state, before: [] }));
    } else {
      if (state.epoch < body.state.epoch) return;  // a late word of a former server
      // Told twice in one frame, such as moved and fallen asleep: one change.
      if (body.state !== state && !(body.region === region && body.tick === decoder.tick)) {
        const held = body.region === region ? this.ticks.get(region) ?? 0 : 0;
        body.before.unshift({ tick: Math.max(body.tick, held), state: body.state });
        if (body.before.length > statesKept) body.before.pop();
      }
      body.region = region;
      body.tick = decoder.tick;
      body.state = state;
    }
    this.changed.push(body);
    const transit = this.transits.get(id);
    if (transit !== undefined && state.epoch >= transit.epoch) this.transits.delete(id);
  }

  #handOver(region, lost) {
    const body = this.bodies.get(lost.id);
    if (body === undefined) return;
    if (lost.why === moved) {
      const known = this.transits.get(lost.id);
      if (lost.epoch > body.state.epoch && lost.epoch > (known?.epoch ?? 0)) {
        this.transits.set(lost.id, { region: lost.region, epoch: lost.epoch, tick: lost.tick });
      }
    } else if (body.region === region && !this.transits.has(lost.id)) {
      this.#lose(lost.id);
    }
  }

  #lose(id) {
    const body = this.bodies.get(id);
    this.bodies.delete(id);
    this.transits.delete(id);
    if (body !== undefined) this.lost.push(body);
  }
}
