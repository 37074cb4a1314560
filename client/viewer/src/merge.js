// One world from the streams of all its servers: each body once, by its epoch, however its servers' frames overtake each
// other, and while servers come and go. The rule is at Cell.moved_tick in proto/aureole/v1/simulation.proto.
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
    // Bodies of which no stream can say where they are now: the one that would have said it has ended.
    this.orphans = new Set();
    this.settlesAt = null;  // who is an orphan still when all regions have told this tick is gone
    this.layoutEpoch = 0;
    // By region, { tick (of the last frame), layoutEpoch, wholeSince, whole }: of the present stream the first and the last
    // tick at which it had told all that is in view; null: none.
    this.regions = new Map();
    // Bodies that were removed, and when: a frame of another region that comes late may still tell of them.
    this.removed = new Map();
    this.changed = [];       // of the last call: bodies
    this.lost = [];          // of the last call: bodies that are gone from the merged world
  }

  clone() {
    const out = new ReplicaMerger();
    out.bodies = new Map([...this.bodies].map(([id, body]) => [id, { ...body, before: body.before.slice() }]));
    out.transits = new Map([...this.transits].map(([id, t]) => [id, { ...t }]));
    out.orphans = new Set(this.orphans);
    out.settlesAt = this.settlesAt;
    out.layoutEpoch = this.layoutEpoch;
    out.regions = new Map([...this.regions].map(([region, told]) => [region, { ...told }]));
    out.removed = new Map(this.removed);
    return out;
  }

  // From here on these regions are the world, by the layout of this epoch; no frame of another one comes. Called before the
  // first frame, and when servers have come or gone. What one that has left told stays as it was until another region
  // tells it, or all have told everything and none has it.
  follow(layoutEpoch, regions) {
    this.layoutEpoch = layoutEpoch;
    this.settlesAt = null;
    for (const region of this.regions.keys()) if (!regions.includes(region)) this.regions.delete(region);
    for (const region of regions) {
      if (this.regions.has(region)) continue;
      this.regions.set(region, { tick: 0, layoutEpoch: 0, wholeSince: null, whole: null });
    }
    for (const [id, body] of this.bodies) {
      if (!this.regions.has(this.transits.get(id)?.region ?? body.region)) this.#orphan(id);
    }
  }

  // After `decoder`, of this region's stream, has taken this frame. A new stream may begin at any time: what the old one
  // told and the new one does not have stays like that of a region that has left.
  apply(region, decoder, frame) {
    this.changed = [];
    this.lost = [];
    const told = this.regions.get(region);
    if (frame.base_tick === 0) told.wholeSince = told.whole = this.settlesAt = null;
    for (const id of decoder.changed) if (decoder.has(id) && !this.removed.has(id)) this.#take(region, decoder, id);
    for (const lost of decoder.lost) {
      if (lost.why === removed) this.removed.set(lost.id, decoder.tick);
      this.#handOver(region, frame, lost);
    }
    told.tick = decoder.tick;
    told.layoutEpoch = Number(frame.layout_epoch);
    if (!frame.more) {
      told.whole = told.tick;
      if (told.wholeSince === null) {
        told.wholeSince = told.tick;
        this.#reconcile(region, decoder);
      }
      this.#settle(region, decoder, told.wholeSince);
      this.#loseOrphans();
    }
    const oldest = Math.min(...[...this.regions.values()].map(({ tick }) => tick));
    for (const [id, tick] of this.removed) if (tick < oldest) this.removed.delete(id);
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
        const held = body.region === region ? this.regions.get(region).tick : 0;
        body.before.unshift({ tick: Math.max(body.tick, held), state: body.state });
        if (body.before.length > statesKept) body.before.pop();
      }
      body.region = region;
      body.tick = decoder.tick;
      body.state = state;
    }
    this.changed.push(body);
    this.orphans.delete(id);
    const transit = this.transits.get(id);
    if (transit !== undefined && state.epoch >= transit.epoch) this.transits.delete(id);
  }

  #handOver(region, frame, lost) {
    const body = this.bodies.get(lost.id);
    if (body === undefined) return;
    if (lost.why === moved) {
      const known = this.transits.get(lost.id);
      if (lost.epoch <= body.state.epoch || lost.epoch <= (known?.epoch ?? -1)) return;
      this.orphans.delete(lost.id);
      this.transits.set(lost.id, { region: lost.region, epoch: lost.epoch, tick: lost.tick });
      // A region that is not known will come with the next layout, or has left since.
      if (!this.regions.has(lost.region) && Number(frame.layout_epoch) <= this.layoutEpoch) this.#orphan(lost.id);
    } else if (body.region === region && !this.transits.has(lost.id)) {
      this.#lose(lost.id);
    }
  }

  // Bodies that should be here by now. A stream that told everything before they came would have said where they went.
  #settle(region, decoder, since) {
    for (const [id, t] of this.transits) {
      if (t.region !== region || decoder.tick < t.tick || decoder.has(id)) continue;
      if (since <= t.tick) this.#lose(id);
      else this.#orphan(id);
    }
  }

  // After a new stream has told all that is in view.
  #reconcile(region, decoder) {
    for (const [id, body] of this.bodies) {
      if (body.region === region && !this.transits.has(id) && !decoder.has(id)) this.#orphan(id);
    }
  }

  // Somebody has each body at each tick. When all have told everything, whoever has an orphan at the newest of their ticks
  // has told it, or will have when it has come to that tick; or will say to whom it has gone.
  #loseOrphans() {
    if (this.orphans.size === 0) return;
    const all = [...this.regions.values()];
    if (!all.every((told) => told.whole !== null && told.layoutEpoch >= this.layoutEpoch)) return;
    this.settlesAt ??= Math.max(...all.map(({ tick }) => tick));
    if (all.every(({ whole }) => whole >= this.settlesAt)) for (const id of this.orphans) this.#lose(id);
  }

  #orphan(id) {
    this.transits.delete(id);
    this.orphans.add(id);
    this.settlesAt = null;
  }

  #lose(id) {
    const body = this.bodies.get(id);
    this.bodies.delete(id);
    this.transits.delete(id);
    this.orphans.delete(id);
    if (body !== undefined) this.lost.push(body);
  }
}
