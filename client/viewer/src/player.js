// Plays a recording into a model, at any speed, from any time.

const checkpointSeconds = 2;
const mostCheckpoints = 48;
const budgetMs = 25;  // of one animation frame, for frames of the recording

export class Player {
  constructor(model, messages, recording, now = () => performance.now()) {
    Object.assign(this, { model, messages, recording, now });
    this.playing = true;
    this.speed = 1;
    this.tick = recording.firstTick;  // shown; may be a fraction
    this.next = 0;                    // entry
    this.at = null;                   // ms, of the last advance
    this.broken = new Set();          // regions whose frames do not follow each other
    this.onStatus = () => {};
    const span = recording.lastTick - recording.firstTick;
    model.setWorld(recording.world);
    this.spacing = Math.max(checkpointSeconds / model.tickSeconds, span / mostCheckpoints);
    this.checkpoints = [];
    this.#advanceTo(this.tick);
  }

  // The recording has not been read as far as it is to be shown.
  get seeking() {
    return this.#wanted(this.tick) > this.next;
  }

  seek(tick) {
    const { firstTick, lastTick } = this.recording;
    this.tick = Math.min(lastTick, Math.max(firstTick, tick));
    if (this.#wanted(this.tick) < this.next) this.#goBack();
  }

  // The tick to show now.
  advance(now) {
    const elapsed = this.at === null ? 0 : Math.min(now - this.at, 250);
    this.at = now;
    if (this.playing && !this.seeking) {
      this.tick = Math.min(this.recording.lastTick, this.tick + (elapsed * this.speed * 0.001) / this.model.tickSeconds);
    }
    if (this.tick >= this.recording.lastTick) this.playing = false;
    this.#advanceTo(this.tick);
    return this.tick;
  }

  // How many entries have to be read to show this tick: those up to it, and one frame of each region after it.
  #wanted(tick) {
    const { entries } = this.recording;
    const after = tick + Math.max(1, this.model.period);
    let low = 0, high = entries.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (entries[middle].tick <= after) low = middle + 1;
      else high = middle;
    }
    // At least the first state.
    return Math.max(low, Math.min(entries.length, this.model.regions));
  }

  #goBack() {
    const wanted = this.#wanted(this.tick);
    let best = null;
    for (const checkpoint of this.checkpoints) if (checkpoint.next <= wanted) best = checkpoint;
    this.broken.clear();
    if (best === null) {
      this.model.setWorld(this.recording.world);
      this.next = 0;
    } else {
      this.model.restore(best.state);
      this.broken = new Set(best.broken);
      this.next = best.next;
    }
  }

  #advanceTo(tick) {
    const end = this.now() + budgetMs;
    for (let wanted = this.#wanted(tick); this.next < wanted; wanted = this.#wanted(tick)) {
      this.#apply(this.recording.entries[this.next++]);
      this.#keep();
      if (this.now() > end) return;
    }
  }

  #keep() {
    const { entries } = this.recording;
    const entry = entries[this.next];
    // Between two ticks only.
    if (entry === undefined || entry.tick === entries[this.next - 1].tick) return;
    const last = this.checkpoints.at(-1);
    const spacing = last === undefined ? 0 : this.spacing;
    if (entry.tick < (last?.tick ?? 0) + spacing || (last !== undefined && last.next >= this.next)) return;
    this.checkpoints.push({ tick: entry.tick, next: this.next, state: this.model.checkpoint(), broken: [...this.broken] });
  }

  #apply(entry) {
    if (entry.kind === 'status') {
      const status = this.messages.decode('RegionStatus', entry.bytes);
      this.model.stream(entry.region).status = status;
      this.onStatus(entry.region, status);
      return;
    }
    try {
      const frame = this.messages.decode('ReplicaFrame', entry.bytes);
      if (frame.base_tick === 0) {
        this.model.beginStream(entry.region);
        this.broken.delete(entry.region);
      }
      if (!this.broken.has(entry.region)) this.model.takeFrame(entry.region, frame, entry.bytes.length);
    } catch {
      // Frames are missing: it goes on where a stream begins.
      this.broken.add(entry.region);
    }
  }
}
