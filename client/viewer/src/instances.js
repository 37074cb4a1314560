// Pieces of one kind: a place per piece, kept dense. Before each picture those in view are handed on, near ones to a level
// with a fine geometry and far ones to one with fewer corners.

const firstCapacity = 64;

export class Instances {
  // `levels`: of levels.js; one, or a fine and a coarse one.
  constructor(levels) {
    this.holders = [];  // of each place: an object whose `place` is kept up to date
    this.matrices = new Float32Array(0);
    this.colours = new Float32Array(0);
    this.radii = new Float32Array(0);
    this.levels = levels;
    this.#grow(firstCapacity);
  }

  // Gives `holder` a place.
  add(holder, radius) {
    if (this.holders.length === this.radii.length) this.#grow(2 * this.holders.length);
    holder.place = this.holders.length;
    this.radii[holder.place] = radius;
    this.holders.push(holder);
  }

  // The last one takes the place that gets free.
  remove(holder) {
    const last = this.holders.pop();
    if (last === holder) return;
    const from = last.place, to = holder.place;
    this.matrices.copyWithin(16 * to, 16 * from, 16 * from + 16);
    this.colours.copyWithin(3 * to, 3 * from, 3 * from + 3);
    this.radii[to] = this.radii[from];
    last.place = to;
    this.holders[to] = last;
  }

  clear() {
    this.holders.length = 0;
  }

  setColour(place, [r, g, b]) {
    this.colours[3 * place] = r;
    this.colours[3 * place + 1] = g;
    this.colours[3 * place + 2] = b;
  }

  colour(place) {
    return [...this.colours.subarray(3 * place, 3 * place + 3)];
  }

  // From a position, an orientation and a scale.
  setPose(place, x, y, z, qx, qy, qz, qw, [sx, sy, sz]) {
    const m = this.matrices, at = 16 * place;
    const x2 = qx + qx, y2 = qy + qy, z2 = qz + qz;
    const xx = qx * x2, xy = qx * y2, xz = qx * z2, yy = qy * y2, yz = qy * z2, zz = qz * z2;
    const wx = qw * x2, wy = qw * y2, wz = qw * z2;
    m[at] = (1 - yy - zz) * sx;
    m[at + 1] = (xy + wz) * sx;
    m[at + 2] = (xz - wy) * sx;
    m[at + 4] = (xy - wz) * sy;
    m[at + 5] = (1 - xx - zz) * sy;
    m[at + 6] = (yz + wx) * sy;
    m[at + 8] = (xz + wy) * sz;
    m[at + 9] = (yz - wx) * sz;
    m[at + 10] = (1 - xx - yy) * sz;
    m[at + 12] = x;
    m[at + 13] = y;
    m[at + 14] = z;
    m[at + 15] = 1;
  }

  // Shows those in view. `planes`: four numbers per side of the view, a normal n and an offset d; a sphere is out of view
  // when n . centre + d < -radius for one of them. `fineWithin`: the distance from `eye`, in radii, up to which the fine
  // geometry is used.
  pack(planes, eye, fineWithin) {
    const { matrices, radii, levels } = this;
    for (const level of levels) level.begin();
    for (let place = 0; place < this.holders.length; ++place) {
      const at = 16 * place, radius = radii[place];
      const x = matrices[at + 12], y = matrices[at + 13], z = matrices[at + 14];
      if (!inView(planes, x, y, z, radius)) continue;
      const dx = x - eye.x, dy = y - eye.y, dz = z - eye.z, far = radius * fineWithin;
      const level = levels.length > 1 && dx * dx + dy * dy + dz * dz > far * far ? 1 : 0;
      levels[level].show(matrices, this.colours, place, eye);
    }
    for (const level of levels) level.end();
  }

  #grow(capacity) {
    this.matrices = grown(this.matrices, 16 * capacity);
    this.colours = grown(this.colours, 3 * capacity);
    this.radii = grown(this.radii, capacity);
    for (const level of this.levels) level.resize(capacity);
  }
}

function grown(array, length) {
  const out = new Float32Array(length);
  out.set(array);
  return out;
}

function inView(planes, x, y, z, radius) {
  for (let i = 0; i < planes.length; i += 4) {
    if (planes[i] * x + planes[i + 1] * y + planes[i + 2] * z + planes[i + 3] < -radius) return false;
  }
  return true;
}
