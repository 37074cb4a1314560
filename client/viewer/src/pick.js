// Which body a ray hits first, on the processor: reading back from a software renderer would take longer.
import { conjugate, rotate } from './shapes.js';

// How far along the ray (direction of length 1) a piece at the origin is hit; Infinity when it is not. From inside: 0.
export function hitPiece(piece, o, d) {
  if (piece.kind === 'sphere') return hitSphere(o, d, piece.radius);
  if (piece.kind === 'box') return hitBox(o, d, piece.half);
  if (piece.kind === 'cylinder') return hitCylinder(o, d, piece.r, piece.half);
  if (piece.kind === 'capsule') return hitCapsule(o, d, piece.r, piece.middle);
  if (piece.kind === 'hull') return hitHull(o, d, planesOf(piece));
  return Infinity;
}

function hitSphere(o, d, radius) {
  const b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2];
  const c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - radius * radius;
  if (c <= 0) return 0;
  const square = b * b - c;
  return square < 0 || b > 0 ? Infinity : -b - Math.sqrt(square);
}

function hitBox(o, d, half) {
  let near = 0, far = Infinity;
  for (let i = 0; i < 3; ++i) {
    if (d[i] === 0) {
      if (Math.abs(o[i]) > half[i]) return Infinity;
      continue;
    }
    const a = (-half[i] - o[i]) / d[i], b = (half[i] - o[i]) / d[i];
    near = Math.max(near, Math.min(a, b));
    far = Math.min(far, Math.max(a, b));
  }
  return near <= far ? near : Infinity;
}

// Where the ray is inside of an endless cylinder along y: [near, far], or null.
function insideRound(o, d, r) {
  const a = d[0] * d[0] + d[2] * d[2];
  const c = o[0] * o[0] + o[2] * o[2] - r * r;
  if (a < 1e-12) return c <= 0 ? [-Infinity, Infinity] : null;
  const b = o[0] * d[0] + o[2] * d[2];
  const square = b * b - a * c;
  if (square < 0) return null;
  const root = Math.sqrt(square);
  return [(-b - root) / a, (-b + root) / a];
}

function hitCylinder(o, d, r, half) {
  const round = insideRound(o, d, r);
  if (round === null) return Infinity;
  const slab = hitBox([0, o[1], 0], [0, d[1], 0], [1, half, 1]);
  if (slab === Infinity) return Infinity;
  const end = d[1] === 0 ? Infinity : Math.max((-half - o[1]) / d[1], (half - o[1]) / d[1]);
  const near = Math.max(0, slab, round[0]);
  return near <= Math.min(end, round[1]) ? near : Infinity;
}

function hitCapsule(o, d, r, middle) {
  const above = hitSphere([o[0], o[1] - middle, o[2]], d, r);
  const below = hitSphere([o[0], o[1] + middle, o[2]], d, r);
  return Math.min(above, below, middle > 0 ? hitCylinder(o, d, r, middle) : Infinity);
}

function hitHull(o, d, planes) {
  let near = 0, far = Infinity;
  for (const { normal: n, offset } of planes) {
    const out = n[0] * o[0] + n[1] * o[1] + n[2] * o[2] - offset;
    const along = n[0] * d[0] + n[1] * d[1] + n[2] * d[2];
    if (Math.abs(along) < 1e-12) {
      if (out > 0) return Infinity;
    } else if (along < 0) near = Math.max(near, -out / along);
    else far = Math.min(far, -out / along);
  }
  return near <= far ? near : Infinity;
}

const hullPlanes = new Map();  // by key

// The faces of a hull, from all triples of its points. A plane is a face when no point is outside of it.
function planesOf(piece) {
  let planes = hullPlanes.get(piece.key);
  if (planes !== undefined) return planes;
  planes = [];
  const points = piece.points.length <= mostHullPoints ? piece.points : [];
  for (let i = 0; i < points.length; ++i) {
    for (let j = i + 1; j < points.length; ++j) {
      for (let k = j + 1; k < points.length; ++k) addFace(planes, points, points[i], points[j], points[k]);
    }
  }
  // Too many points: a sphere has to do.
  if (planes.length === 0) planes = cubePlanes(piece.radius);
  hullPlanes.set(piece.key, planes);
  return planes;
}

const mostHullPoints = 48;  // the search grows with the fourth power

function addFace(planes, points, a, b, c) {
  const u = b.map((v, i) => v - a[i]), v = c.map((x, i) => x - a[i]);
  let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
  const length = Math.hypot(...n);
  if (length < 1e-9) return;
  n = n.map((x) => x / length);
  let offset = n[0] * a[0] + n[1] * a[1] + n[2] * a[2];
  // The origin is inside.
  if (offset < 0) {
    n = n.map((x) => -x);
    offset = -offset;
  }
  const slack = 1e-6 + 1e-4 * Math.abs(offset);
  if (points.some((p) => n[0] * p[0] + n[1] * p[1] + n[2] * p[2] > offset + slack)) return;
  const known = planes.some((p) => Math.abs(p.offset - offset) < slack && p.normal.every((x, i) => Math.abs(x - n[i]) < 1e-4));
  if (!known) planes.push({ normal: n, offset });
}

function cubePlanes(radius) {
  const side = radius / Math.sqrt(3);
  return [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]].map((normal) => ({ normal, offset: side }));
}

// The first body on a ray from `origin` along `direction` (length 1): { body, distance, point (in the body's frame) } or
// null. `bodies`: things with `pose` (position and orientation, seven numbers), `pieces` and `reach`.
export function pickBody(bodies, origin, direction) {
  let best = null;
  for (const body of bodies) {
    const pose = body.pose;
    const o = [origin[0] - pose[0], origin[1] - pose[1], origin[2] - pose[2]];
    const around = hitSphere(o, direction, body.reach);
    if (around === Infinity || (best !== null && around >= best.distance)) continue;
    const turn = conjugate([pose[3], pose[4], pose[5], pose[6]]);
    const localOrigin = rotate(turn, o), localDirection = rotate(turn, direction);
    for (const piece of body.pieces) {
      const turnPiece = conjugate(piece.orientation);
      const from = rotate(turnPiece, localOrigin.map((v, i) => v - piece.position[i]));
      const distance = hitPiece(piece, from, rotate(turnPiece, localDirection));
      if (distance === Infinity || (best !== null && distance >= best.distance)) continue;
      best = { body, distance, point: localOrigin.map((v, i) => v + localDirection[i] * distance) };
    }
  }
  return best;
}
