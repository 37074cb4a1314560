// Which simulated time a live world is shown at: two frames behind the newest, moving evenly although frames do not come
// evenly, and never back.

const jump = 0.5;       // s of error that is followed at once
const correction = 2;   // 1/s
const mostChange = 0.5; // of the speed

export class LiveClock {
  constructor() {
    this.reset();
  }

  reset() {
    this.tick = 0;  // shown; may be a fraction
    this.newest = 0;
    this.arrived = 0;  // ms, of the newest
    this.at = 0;       // ms, of the last advance
  }

  // A frame of this tick has come.
  take(tick, now) {
    if (tick <= this.newest) return;
    this.newest = tick;
    this.arrived = now;
  }

  // The tick to show now. `factor`: simulated per wall time; `period`: ticks between frames.
  advance(now, { tickSeconds, factor, period }) {
    if (this.newest === 0) return 0;
    const perMs = (0.001 / tickSeconds) * factor;
    // When no frames come, the last one is the end.
    const since = Math.min((now - this.arrived) * perMs, 2 * period);
    const target = Math.min(this.newest + since - 2 * period, this.newest);
    const step = Math.max(0, now - this.at);
    this.at = now;
    const error = (target - this.tick) * tickSeconds;
    if (this.tick === 0 || error > jump || error < -4 * jump) {
      this.tick = Math.max(0, target);
      return this.tick;
    }
    const change = Math.min(mostChange, Math.max(-mostChange, correction * error));
    this.tick = Math.min(this.tick + step * perMs * (1 + change), Math.max(this.tick, this.newest));
    return this.tick;
  }
}
