// Where a body that is fixed, or follows a script, is at a simulated time.
import { orientationOf, vectorOf } from './shapes.js';

const seconds = (duration) => (duration ? duration.seconds + duration.nanos * 1e-9 : 0);

// [{ time (s), position, orientation }, ...] of a FixedBody.
export function keysOf(fixed) {
  const keys = fixed.keys.map((key) => ({
    time: seconds(key.time), position: vectorOf(key.position), orientation: orientationOf(key.orientation, key.turn),
  }));
  return keys.length > 0 ? keys : [{ time: 0, position: [0, 0, 0], orientation: [0, 0, 0, 1] }];
}

export function periodOf(fixed) {
  return seconds(fixed.period);
}

// Linear in position, and the shortest turn, between keys. `period`: 0 for none.
export function scriptedPose(keys, period, time) {
  const t = period > 0 ? time - Math.floor(time / period) * period : time;
  let next = keys.findIndex((key) => key.time > t);
  if (next < 0) next = keys.length;
  const a = keys[Math.max(0, next - 1)], b = keys[Math.min(next, keys.length - 1)];
  const share = b.time > a.time ? Math.min(1, Math.max(0, (t - a.time) / (b.time - a.time))) : 0;
  return {
    position: a.position.map((v, i) => v + (b.position[i] - v) * share),
    orientation: slerp(a.orientation, b.orientation, share),
  };
}

function slerp(a, b, t) {
  let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = dot < 0 ? -1 : 1;
  dot = Math.min(1, Math.abs(dot));
  const angle = Math.acos(dot);
  const s = Math.sin(angle);
  const u = s < 1e-6 ? 1 - t : Math.sin((1 - t) * angle) / s;
  const v = (s < 1e-6 ? t : Math.sin(t * angle) / s) * sign;
  return a.map((x, i) => x * u + b[i] * v);
}
