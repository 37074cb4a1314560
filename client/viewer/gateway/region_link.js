// What one region server tells one browser: its replicas and its status. Opened, passed on, and opened again when it
// was lost.
import { status, textOf } from './rpc.js';

const minBackoff = 100, maxBackoff = 2000;  // ms

export class RegionLink {
  // `events`: frame(bytes of a PlayResponse), layout(bytes of a LayoutUpdate), up(), down(message).
  // `outlet`: full() says that the browser is behind, room(fn) calls fn once when it no longer is.
  constructor({ rpc, endpoint, watch, auras, events, outlet }) {
    Object.assign(this, { rpc, endpoint, watch, auras, events, outlet });
    this.up = false;
    this.ended = false;
    this.play = null;
    this.layout = null;
    this.backoff = minBackoff;
    this.timers = new Set();
    this.#openPlay();
    this.#openLayout();
  }

  // The browser has read the frame of this tick. Servers wait with new frames for those who say nothing.
  acknowledge(tick) {
    if (this.up && !this.outlet.full()) this.play?.write({ acknowledged_tick: tick });
  }

  // Begins anew, such as when the browser could not read a frame.
  restart() {
    this.play?.cancel();
  }

  setAuras(on) {
    if (this.auras === on) return;
    this.auras = on;
    this.layout?.cancel();
  }

  close() {
    this.ended = true;
    for (const timer of this.timers) clearTimeout(timer);
    this.play?.cancel();
    this.layout?.cancel();
  }

  #later(ms, fn) {
    const timer = setTimeout(() => {
      this.timers.delete(timer);
      if (!this.ended) fn();
    }, ms);
    this.timers.add(timer);
  }

  #openPlay() {
    if (this.outlet.full()) return this.outlet.room(() => this.ended || this.#openPlay());
    const play = (this.play = this.rpc.play(this.endpoint));
    play.on('data', (bytes) => {
      if (this.play !== play || this.ended) return;
      if (!this.up) {
        this.up = true;
        this.backoff = minBackoff;
        this.events.up();
      }
      this.events.frame(bytes);
      if (!this.outlet.full()) return;
      // What is not read here is not sent there: the server skips frames instead.
      play.pause();
      this.outlet.room(() => play.resume());
    });
    play.on('error', () => {});  // its status follows
    play.on('status', (result) => {
      if (this.play !== play) return;
      this.play = null;
      this.up = false;
      if (this.ended) return;
      this.events.down(textOf(result));
      this.#later(this.backoff, () => this.#openPlay());
      this.backoff = Math.min(2 * this.backoff, maxBackoff);
    });
    play.write({ watch: this.watch });
  }

  #openLayout() {
    const layout = (this.layout = this.rpc.watchLayout(this.endpoint, { auras: this.auras }));
    const auras = this.auras;
    layout.on('data', (bytes) => {
      // Each status replaces the one before, so those that the browser has no room for are left out. Field 1 is the layout.
      if (!this.ended && (bytes[0] === 0x0a || !this.outlet.full())) this.events.layout(bytes);
    });
    layout.on('error', () => {});
    layout.on('status', (result) => {
      this.layout = null;
      if (this.ended || result.code === status.UNIMPLEMENTED) return;
      this.#later(auras === this.auras ? 1000 : 0, () => this.#openLayout());
    });
  }
}
