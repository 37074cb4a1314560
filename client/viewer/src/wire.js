// Reads protobuf messages by field tables (scripts/tables.js). It generates no code, so that the page's content security
// policy can forbid that. Numbers of 64 bits that are ids (uint64, fixed64) become BigInt, signed ones (ticks, counts)
// Number. What is not there has proto3's default; messages that are not there are null.

const deepest = 64;  // messages in messages

class Reader {
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 0;
    this.low = 0;
    this.middle = 0;
    this.high = 0;
  }

  // The low 32 bits of a varint; all of it in low (28 bits), middle (28) and high (8).
  varint() {
    const bytes = this.bytes;
    let b = bytes[this.at++];
    if (b < 0x80) {
      this.middle = this.high = 0;
      return (this.low = b);
    }
    let low = b & 0x7f, middle = 0, high = 0;
    for (let shift = 7; ; shift += 7) {
      if (shift > 63) throw new Error('a varint of more than ten bytes');
      b = bytes[this.at++];
      if (b === undefined) throw new Error('a message that ends too early');
      const part = b & 0x7f;
      if (shift < 28) low |= part << shift;
      else if (shift < 56) middle |= part << (shift - 28);
      else high |= part << (shift - 56);
      if (b < 0x80) break;
    }
    this.low = low;
    this.middle = middle;
    this.high = high & 0xff;
    return (low | (middle << 28)) >>> 0;
  }

  unsigned64() {
    this.varint();
    if (this.high === 0 && this.middle < 0x2000000) return BigInt(this.middle * 0x10000000 + this.low);
    return (BigInt(this.high) << 56n) | (BigInt(this.middle) << 28n) | BigInt(this.low);
  }

  signed64() {
    this.varint();
    if (this.high === 0) return this.middle * 0x10000000 + this.low;
    return Number(BigInt.asIntN(64, (BigInt(this.high) << 56n) | (BigInt(this.middle) << 28n) | BigInt(this.low)));
  }

  bytesOf(length) {
    const begin = this.at;
    if (begin + length > this.bytes.length) throw new Error('a message that ends too early');
    this.at += length;
    return this.bytes.subarray(begin, this.at);
  }
}

const text = new TextDecoder();

// Of one value each. Fixed sizes throw RangeError at the end by themselves.
const readers = {
  int32: (r) => r.varint() | 0,
  uint32: (r) => r.varint(),
  sint32: (r) => {
    const n = r.varint();
    return (n >>> 1) ^ -(n & 1);
  },
  bool: (r) => r.varint() !== 0 || r.middle !== 0 || r.high !== 0,
  int64: (r) => r.signed64(),
  uint64: (r) => r.unsigned64(),
  fixed64: (r) => r.view.getBigUint64((r.at += 8) - 8, true),
  fixed32: (r) => r.view.getUint32((r.at += 4) - 4, true),
  double: (r) => r.view.getFloat64((r.at += 8) - 8, true),
  float: (r) => r.view.getFloat32((r.at += 4) - 4, true),
  string: (r) => text.decode(r.bytesOf(r.varint())),
  bytes: (r) => r.bytesOf(r.varint()),
};

const defaults = {
  int32: 0, uint32: 0, sint32: 0, bool: false, int64: 0, uint64: 0n, fixed64: 0n, fixed32: 0, double: 0, float: 0,
  string: '', bytes: new Uint8Array(0), message: null,
};

const nothing = Object.freeze([]);

export class Messages {
  constructor(tables) {
    this.types = new Map();
    for (const [name, rows] of Object.entries(tables)) {
      const type = { fields: [], defaults: {} };
      for (const [number, field, kind, repeated, message, optional] of rows) {
        if (kind !== 'message' && !readers[kind]) throw new Error(`${name}.${field}: no reader for ${kind}`);
        const packs = kind !== 'string' && kind !== 'bytes';
        type.fields[number] = { name: field, kind, repeated, message, read: readers[kind], packs };
        type.defaults[field] = repeated ? nothing : optional ? undefined : defaults[kind];
      }
      this.types.set(name, type);
    }
    for (const type of this.types.values()) {
      for (const field of type.fields) if (field?.message) field.type = this.types.get(field.message);
    }
  }

  // Throws an Error when `bytes` is not such a message.
  decode(name, bytes) {
    const type = this.types.get(`aureole.v1.${name}`);
    if (!type) throw new Error(`no message ${name}`);
    return readMessage(type, new Reader(bytes), bytes.length, 0);
  }
}

function readMessage(type, r, end, depth) {
  if (end > r.bytes.length) throw new Error('a message that ends too early');
  if (depth > deepest) throw new Error('messages nested too deep');
  const out = Object.create(type.defaults);
  while (r.at < end) {
    const tag = r.varint();
    const field = type.fields[tag >>> 3];
    const wire = tag & 7;
    if (field === undefined) skip(r, wire);
    else if (field.kind === 'message') readInner(field, r, wire, out, depth);
    else if (field.repeated && wire === 2 && field.packs) readPacked(field, r, out);
    else if (field.repeated) listOf(out, field.name).push(field.read(r));
    else out[field.name] = field.read(r);
  }
  if (r.at !== end) throw new Error('a message that ends too early');
  return out;
}

function readInner(field, r, wire, out, depth) {
  if (wire !== 2) throw new Error(`${field.name} is not a message`);
  const length = r.varint();
  const inner = readMessage(field.type, r, r.at + length, depth + 1);
  if (field.repeated) listOf(out, field.name).push(inner);
  else out[field.name] = inner;
}

function readPacked(field, r, out) {
  const end = r.varint() + r.at;
  if (end > r.bytes.length) throw new Error('a message that ends too early');
  const list = listOf(out, field.name);
  const read = field.read;
  while (r.at < end) list.push(read(r));
  if (r.at !== end) throw new Error('a column that ends too early');
}

function listOf(out, name) {
  return Object.hasOwn(out, name) ? out[name] : (out[name] = []);
}

function skip(r, wire) {
  if (wire === 0) r.varint();
  else if (wire === 1) r.bytesOf(8);
  else if (wire === 2) r.bytesOf(r.varint());
  else if (wire === 5) r.bytesOf(4);
  else throw new Error(`a field of wire type ${wire}`);
}
