// Frames for tests: made with protobufjs, read with the page's own reader.
import { fieldTables } from '../scripts/tables.js';
import { loadProto } from '../gateway/proto.js';
import { Messages } from '../src/wire.js';

export const root = loadProto();
export const messages = new Messages(fieldTables(root));

export function encode(type, object) {
  const message = root.lookupType(`aureole.v1.${type}`);
  return new Uint8Array(message.encode(message.fromObject(object)).finish());
}

// As a reader gets it.
export function told(type, object) {
  return messages.decode(type, encode(type, object));
}

// Ascending ids as the differences that columns hold.
export function differences(ids) {
  return ids.map((id, i) => String(BigInt(id) - (i === 0 ? 0n : BigInt(ids[i - 1]))));
}

// A cell that tells of new bodies: { id, epoch, at: [x, y, z] relative to the cell's corner, m }.
export function cellOf(x, z, bodies, more = {}) {
  return {
    x, z,
    new_id: differences(bodies.map((b) => b.id)),
    new_epoch: bodies.map((b) => b.epoch ?? 0),
    new_position: bodies.flatMap((b) => b.at.map((v) => Math.round(v * 2048))),
    new_orientation: bodies.flatMap(() => [0, 0, 0]),
    new_largest: bodies.map(() => 3),
    ...more,
  };
}

export function frameOf(tick, base, cells, more = {}) {
  return told('ReplicaFrame', { tick, base_tick: base, cells, real_time_factor: 1, ...more });
}

export function sphereOf(ids, radius = 0.5) {
  return { body: differences(ids), shape: { sphere: { radius } }, mass: 2 };
}
