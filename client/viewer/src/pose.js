// Where a body is at a simulated time, from the states that were told of it.

// Writes seven numbers to out: position, orientation (x, y, z, w). `tick` may be a fraction. True when the pose will not
// change with time until something new is told.
export function poseAt(body, tick, out) {
  let later = body.state, laterTick = body.tick;
  if (tick >= laterTick) {
    copy(later, out);
    return true;
  }
  for (const before of body.before) {
    if (tick >= before.tick) {
      mix(before.state, later, (tick - before.tick) / Math.max(laterTick - before.tick, 1e-9), out);
      return false;
    }
    later = before.state;
    laterTick = before.tick;
  }
  copy(later, out);
  return false;
}

function copy(state, out) {
  const p = state.position, q = state.orientation;
  out[0] = p[0];
  out[1] = p[1];
  out[2] = p[2];
  out[3] = q[0];
  out[4] = q[1];
  out[5] = q[2];
  out[6] = q[3];
}

// Orientations linearly along the shorter way: close enough to the arc for the small turns between frames.
function mix(a, b, t, out) {
  const p = a.position, q = a.orientation, r = b.position, s = b.orientation;
  for (let i = 0; i < 3; ++i) out[i] = p[i] + (r[i] - p[i]) * t;
  const dot = q[0] * s[0] + q[1] * s[1] + q[2] * s[2] + q[3] * s[3];
  const u = dot < 0 ? -t : t;
  let square = 0;
  for (let i = 0; i < 4; ++i) {
    out[3 + i] = q[i] * (1 - t) + s[i] * u;
    square += out[3 + i] * out[3 + i];
  }
  const scale = square > 0 ? 1 / Math.sqrt(square) : 1;
  for (let i = 3; i < 7; ++i) out[i] *= scale;
}
