// Shapes as the interface tells them, taken apart into pieces that are drawn and picked alike.

const identity = [0, 0, 0, 1];

// ---- quaternions and vectors, as arrays ----

export function rotate(q, v) {
  const [x, y, z, w] = q;
  const tx = 2 * (y * v[2] - z * v[1]), ty = 2 * (z * v[0] - x * v[2]), tz = 2 * (x * v[1] - y * v[0]);
  return [
    v[0] + w * tx + y * tz - z * ty,
    v[1] + w * ty + z * tx - x * tz,
    v[2] + w * tz + x * ty - y * tx,
  ];
}

export function conjugate(q) {
  return [-q[0], -q[1], -q[2], q[3]];
}

export function multiply(a, b) {
  return [
    a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
    a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
    a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
    a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
  ];
}

// Of a message Vec3 or null.
export function vectorOf(v) {
  return v === null || v === undefined ? [0, 0, 0] : [v.x, v.y, v.z];
}

// Of a message Quaternion, or a Turn instead; the identity when there is neither.
export function orientationOf(q, turn) {
  if (q) {
    const length = Math.hypot(q.x, q.y, q.z, q.w);
    return length > 0 ? [q.x / length, q.y / length, q.z / length, q.w / length] : identity;
  }
  if (!turn) return identity;
  const axis = vectorOf(turn.axis);
  const length = Math.hypot(...axis);
  if (length === 0) return identity;
  const half = (turn.degrees * Math.PI) / 360, s = Math.sin(half) / length;
  return [axis[0] * s, axis[1] * s, axis[2] * s, Math.cos(half)];
}

// ---- pieces ----

// [{ kind, key, scale, position, orientation, radius, ... }, ...]. Pieces of one `key` have one geometry, which `scale`
// stretches; `radius` is that of a sphere around the piece's origin that holds it. Planes are not among them.
export function piecesOf(shape, position = [0, 0, 0], orientation = identity) {
  const place = (piece) => [{ ...piece, position, orientation }];
  if (shape?.sphere) {
    const r = shape.sphere.radius;
    return place({ kind: 'sphere', key: 'sphere', scale: [r, r, r], radius: r });
  }
  if (shape?.box) {
    const size = vectorOf(shape.box.size);
    return place({ kind: 'box', key: 'box', scale: size, half: size.map((s) => s / 2), radius: Math.hypot(...size) / 2 });
  }
  if (shape?.capsule) {
    const { radius: r, height } = shape.capsule;
    const middle = Math.max(0, height / 2 - r);
    const key = `capsule ${(middle / r).toFixed(4)}`;
    return place({ kind: 'capsule', key, scale: [r, r, r], r, middle, radius: middle + r });
  }
  if (shape?.cylinder) {
    const { radius: r, height } = shape.cylinder;
    const half = height / 2;
    return place({ kind: 'cylinder', key: 'cylinder', scale: [r, height, r], r, half, radius: Math.hypot(r, half) });
  }
  if (shape?.hull) {
    const points = shape.hull.points.map(vectorOf);
    const radius = Math.max(...points.map((p) => Math.hypot(...p)));
    return place({ kind: 'hull', key: `hull ${points.flat().join(' ')}`, scale: [1, 1, 1], points, radius });
  }
  if (shape?.mesh) return place({ kind: 'mesh', key: '', scale: [1, 1, 1], mesh: shape.mesh, radius: Infinity });
  if (shape?.heightfield) {
    return place({ kind: 'heightfield', key: '', scale: [1, 1, 1], field: shape.heightfield, radius: Infinity });
  }
  if (shape?.compound) {
    return shape.compound.children.flatMap((child) => {
      const q = orientationOf(child.orientation, child.turn);
      const at = rotate(orientation, vectorOf(child.position)).map((v, i) => v + position[i]);
      return piecesOf(child.shape, at, multiply(orientation, q));
    });
  }
  return [];
}

// A sphere around the body's origin that holds all pieces.
export function reachOf(pieces) {
  return pieces.reduce((most, p) => Math.max(most, Math.hypot(...p.position) + p.radius), 0);
}

// How far a body of BodyView reaches along each of its axes.
export function extentOf({ pieces, reach, simple }) {
  const [piece] = pieces;
  if (simple && piece.kind === 'box') return piece.half;
  if (simple && piece.kind === 'cylinder') return [piece.r, piece.half, piece.r];
  if (simple && piece.kind === 'capsule') return [piece.r, piece.middle + piece.r, piece.r];
  return [reach, reach, reach];
}

// For people.
export function describeShape(shape) {
  const m = (v) => `${Number(v.toFixed(3))}`;
  if (shape?.sphere) return `sphere, radius ${m(shape.sphere.radius)} m`;
  if (shape?.box) return `box, ${vectorOf(shape.box.size).map(m).join(' × ')} m`;
  if (shape?.capsule) return `capsule, radius ${m(shape.capsule.radius)} m, height ${m(shape.capsule.height)} m`;
  if (shape?.cylinder) return `cylinder, radius ${m(shape.cylinder.radius)} m, height ${m(shape.cylinder.height)} m`;
  if (shape?.hull) return `hull of ${shape.hull.points.length} points`;
  if (shape?.compound) return `compound of ${shape.compound.children.length}`;
  return 'unknown';
}
