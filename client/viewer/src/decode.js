// Reads the ReplicaFrames of one stream back into bodies; proto/aureole/v1/simulation.proto says how they are told.

const cellSize = 32;  // m
const unitsOf = {
  FINE: { position: 1 / 2048, orientation: 1 / 4096, velocity: 1 / 64 },
  COARSE: { position: 1 / 128, orientation: 1 / 512, velocity: 1 / 8 },
};
const bitWidths = [0, 4, 6, 8, 10, 12, 14, 32];

// Why a stream tells a body no more.
export const outOfView = 0, removed = 1, moved = 2;

// A body in a cell: { id, epoch, asleep, largest, integers (position, orientation, velocities), exact (or null) }.
function copyEntry(e) {
  return { ...e, integers: e.integers.slice(), exact: e.exact === null ? null : e.exact.slice() };
}

// Where `id` is, or would be, in entries that ascend by id.
function indexOf(entries, id) {
  let low = 0, high = entries.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (entries[middle].id < id) low = middle + 1;
    else high = middle;
  }
  return low;
}

function find(entries, id) {
  const e = entries[indexOf(entries, id)];
  return e !== undefined && e.id === id ? e : null;
}

// Calls fn(id, index) for a column of ids, which are told as differences.
function eachId(column, fn) {
  let id = 0n;
  for (let i = 0; i < column.length; ++i) fn((id += column[i]), i);
}

class BitReader {
  constructor(bytes) {
    this.bytes = bytes;
    this.at = 0;
  }
  // Zeros after the end.
  read(n) {
    let out = 0;
    for (let i = 0; i < n; ++i, ++this.at) {
      if ((this.bytes[this.at >> 3] >> (this.at & 7)) & 1) out |= 1 << i;
    }
    return out;
  }
  readSigned(n) {
    const value = this.read(n);
    return n === 0 || n === 32 ? value : (value << (32 - n)) >> (32 - n);
  }
  atEnd() {
    return this.at + 8 > this.bytes.length * 8;
  }
}

export class ReplicaDecoder {
  // Whether velocities and whole doubles are told shows in the frames themselves; FINE and COARSE do not.
  constructor(precision = 'FINE') {
    this.units = unitsOf[precision];
    this.tick = 0;
    this.velocities = false;
    this.cells = new Map();  // "x,z" -> entries, ascending
    this.where = new Map();  // id -> "x,z"
    this.changed = [];  // ids, of the last frame
    this.lost = [];     // { id, why, region, epoch, tick }, of the last frame
  }

  clone() {
    const out = Object.assign(new ReplicaDecoder(), this);
    out.cells = new Map([...this.cells].map(([key, entries]) => [key, entries.map(copyEntry)]));
    out.where = new Map(this.where);
    out.changed = [];
    out.lost = [];
    return out;
  }

  // Takes the next frame. Throws when it is not one that can follow; the stream then has to be begun anew with a new
  // decoder.
  apply(frame) {
    this.changed = [];
    this.lost = [];
    if (frame.base_tick !== this.tick) {
      throw new Error(`a frame after tick ${frame.base_tick} where tick ${this.tick} was the last`);
    }
    if (frame.tick <= this.tick || frame.dropped.length % 2 !== 0) {
      throw new Error(`a frame of tick ${frame.tick} after tick ${this.tick}`);
    }
    this.#drop(frame.dropped);
    for (const cell of frame.cells) this.#applyCell(frame, cell);
    this.tick = frame.tick;
    this.#settleLost();
    this.#addPassed(frame);
  }

  has(id) {
    return this.where.has(id);
  }

  // Requires has(id). World frame, SI units; velocities are null when they are not told.
  get(id) {
    const e = find(this.cells.get(this.where.get(id)), id);
    const state = { epoch: e.epoch, asleep: e.asleep, position: null, orientation: null, velocity: null, spin: null };
    if (e.exact !== null) {
      state.position = e.exact.slice(0, 3);
      state.orientation = e.exact.slice(3, 7);
      state.velocity = e.exact.slice(7, 10);
      state.spin = e.exact.slice(10, 13);
      return state;
    }
    const n = e.integers, u = this.units;
    state.position = [n[0] * u.position, n[1] * u.position, n[2] * u.position];
    const q = [0, 0, 0, 0];
    let rest = 1;
    for (let from = 3, to = 0; to < 4; ++to) {
      if (to === e.largest) continue;
      q[to] = n[from++] * u.orientation;
      rest -= q[to] * q[to];
    }
    q[e.largest] = Math.sqrt(Math.max(0, rest));
    state.orientation = q;
    if (this.velocities) {
      state.velocity = [n[6] * u.velocity, n[7] * u.velocity, n[8] * u.velocity];
      state.spin = [n[9] * u.velocity, n[10] * u.velocity, n[11] * u.velocity];
    }
    return state;
  }

  #drop(dropped) {
    for (let i = 0; i < dropped.length; i += 2) {
      const key = `${dropped[i]},${dropped[i + 1]}`;
      for (const e of this.cells.get(key) ?? []) {
        if (this.where.get(e.id) === key) this.lost.push({ id: e.id, why: outOfView });
      }
      this.cells.delete(key);
    }
  }

  #applyCell(frame, cell) {
    const key = `${cell.x},${cell.z}`;
    let entries = this.cells.get(key);
    if (entries === undefined) this.cells.set(key, (entries = []));
    try {
      this.#change(cell, entries);
      this.#takeOut(frame, cell, key, entries);
      this.#add(cell, key, entries);
    } catch (error) {
      throw new Error(`cell ${key} of tick ${frame.tick}: ${error.message}`);
    }
    this.#setAsleep(cell.slept, entries, true);
    this.#setAsleep(cell.woke, entries, false);
    if (entries.length === 0) this.cells.delete(key);
  }

  #setAsleep(column, entries, asleep) {
    eachId(column, (id) => {
      const e = find(entries, id);
      if (e === null) return;
      e.asleep = asleep;
      this.changed.push(id);
    });
  }

  #change(cell, entries) {
    if (cell.bits.length > 0) return this.#readBits(cell.bits, entries);
    const n = cell.id.length;
    const exact = cell.exact.length > 0;
    if (exact) {
      if (cell.exact.length !== 13 * (n + cell.new_id.length)) throw new Error('exact has not 13 values per body');
    } else if (cell.position.length !== 3 * n || cell.orientation.length !== 3 * n ||
               (cell.velocity.length !== 0 && cell.velocity.length !== 6 * n)) {
      throw new Error('columns of different lengths');
    }
    const velocities = cell.velocity.length > 0;
    eachId(cell.id, (id, i) => {
      const e = find(entries, id);
      if (e === null) throw new Error('a difference for a body that is not there');
      this.changed.push(id);
      if (exact) {
        const at = 13 * (cell.new_id.length + i);
        e.exact = cell.exact.slice(at, at + 13);
        return;
      }
      const to = e.integers;
      for (let k = 0; k < 3; ++k) {
        to[k] = (to[k] + cell.position[3 * i + k]) | 0;
        to[3 + k] = (to[3 + k] + cell.orientation[3 * i + k]) | 0;
      }
      if (velocities) for (let k = 0; k < 6; ++k) to[6 + k] = (to[6 + k] + cell.velocity[6 * i + k]) | 0;
    });
  }

  #readBits(bytes, entries) {
    const reader = new BitReader(bytes);
    for (const e of entries) {
      if (reader.read(1) === 0) continue;
      this.changed.push(e.id);
      for (let k = 0; k < (this.velocities ? 12 : 6); k += 3) {
        const width = bitWidths[reader.read(3)];
        for (let i = k; i < k + 3; ++i) e.integers[i] = (e.integers[i] + reader.readSigned(width)) | 0;
      }
    }
    if (!reader.atEnd()) throw new Error('bits of more bodies than are there');
  }

  #takeOut(frame, cell, key, entries) {
    if (cell.why.length !== cell.gone.length || cell.moved_tick.length !== cell.moved_epoch.length) {
      throw new Error('gone bodies without a reason');
    }
    let next = 0;  // of those that moved
    eachId(cell.gone, (id, i) => {
      const index = indexOf(entries, id);
      if (entries[index]?.id !== id) throw new Error('a body is gone that was not there');
      const why = cell.why[i];
      const lost = { id, why: Math.min(why, moved) };
      if (why >= moved) {
        if (next >= cell.moved_tick.length) throw new Error('moved bodies without their tick');
        lost.region = why - 2;
        lost.epoch = cell.moved_epoch[next];
        lost.tick = frame.tick + cell.moved_tick[next++];
      }
      entries.splice(index, 1);
      if (this.where.get(id) === key) this.lost.push(lost);
    });
  }

  #add(cell, key, entries) {
    const n = cell.new_id.length;
    if (n === 0) return;
    const exact = cell.exact.length > 0;
    if (cell.new_epoch.length !== n) throw new Error('new bodies without an epoch');
    if (!exact && (cell.new_position.length !== 3 * n || cell.new_orientation.length !== 3 * n ||
                   cell.new_largest.length !== n ||
                   (cell.new_velocity.length !== 0 && cell.new_velocity.length !== 6 * n))) {
      throw new Error('columns of new bodies of different lengths');
    }
    this.velocities = exact || cell.new_velocity.length > 0;
    const corner = cellSize / this.units.position;
    eachId(cell.new_id, (id, i) => {
      const index = indexOf(entries, id);
      let e = entries[index];
      if (e?.id !== id) {
        e = { id, epoch: 0, asleep: false, largest: 3, integers: new Array(12).fill(0), exact: null };
        entries.splice(index, 0, e);
      }
      e.epoch = cell.new_epoch[i];
      this.where.set(id, key);
      this.changed.push(id);
      if (exact) {
        e.exact = cell.exact.slice(13 * i, 13 * i + 13);
        return;
      }
      if (cell.new_largest[i] > 3) throw new Error('an orientation without its largest component');
      e.largest = cell.new_largest[i];
      for (let k = 0; k < 3; ++k) {
        e.integers[k] = cell.new_position[3 * i + k];
        e.integers[3 + k] = cell.new_orientation[3 * i + k];
      }
      e.integers[0] = (e.integers[0] + cell.x * corner) | 0;
      e.integers[2] = (e.integers[2] + cell.z * corner) | 0;
      if (this.velocities) for (let k = 0; k < 6; ++k) e.integers[6 + k] = cell.new_velocity[6 * i + k];
    });
  }

  // What is in another cell now is not lost.
  #settleLost() {
    this.lost = this.lost.filter(({ id }) => {
      const key = this.where.get(id);
      if (key === undefined) return false;
      const entries = this.cells.get(key);
      if (entries !== undefined && find(entries, id) !== null) return false;
      this.where.delete(id);
      return true;
    });
  }

  #addPassed(frame) {
    const n = frame.passed.length;
    if (frame.passed_region.length !== n || frame.passed_epoch.length !== n || frame.passed_tick.length !== n) {
      throw new Error('columns of passed bodies of different lengths');
    }
    eachId(frame.passed, (id, i) => {
      const tick = this.tick + frame.passed_tick[i];
      this.lost.push({ id, why: moved, region: frame.passed_region[i], epoch: frame.passed_epoch[i], tick });
    });
  }
}
