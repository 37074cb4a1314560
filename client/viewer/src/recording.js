// Opens recordings: MCAP files, uncompressed, with the messages of the interface.
import { McapStreamReader } from '@mcap/core';

const slice = 4 << 20;  // bytes that are read at once, so that the page stays alive

// { world, entries: [{ tick, region, kind ('frame' or 'status'), bytes }, ...] in order of ticks, firstTick, lastTick }.
// Throws an Error for people when it is not a recording. `progress(share)` is called now and then.
export async function readRecording(file, messages, progress = () => {}) {
  const reader = new McapStreamReader();
  const channels = new Map();
  const out = { world: null, entries: [], firstTick: Infinity, lastTick: 0 };
  const bytes = new Uint8Array(file);
  for (let at = 0; at < bytes.length; at += slice) {
    try {
      reader.append(bytes.subarray(at, at + slice));
      for (let record; (record = reader.nextRecord()) !== undefined; ) takeRecord(record, channels, messages, out);
    } catch (error) {
      if (at === 0) throw new Error(`not a recording: ${error.message}`);
      // A recording that was cut off is shown as far as it goes.
      if (out.world === null || out.entries.length === 0) throw new Error(`a damaged recording: ${error.message}`);
      break;
    }
    progress(Math.min(1, (at + slice) / bytes.length));
    await new Promise((resolve) => setTimeout(resolve));
  }
  if (out.world === null) throw new Error('not a recording of Aureole: it has no message on /world');
  const ticks = out.world.tick_us * 1000;  // ns
  for (const entry of out.entries) entry.tick = Math.round(Number(entry.time) / ticks);
  out.entries.sort((a, b) => a.tick - b.tick);
  for (const entry of out.entries) {
    if (entry.kind !== 'frame') continue;
    out.firstTick = Math.min(out.firstTick, entry.tick);
    out.lastTick = Math.max(out.lastTick, entry.tick);
  }
  if (out.firstTick === Infinity) throw new Error('a recording without frames');
  return out;
}

const topics = [
  [/^\/region\/(\d+)\/frames$/, 'aureole.v1.ReplicaFrame', 'frame'],
  [/^\/region\/(\d+)\/status$/, 'aureole.v1.RegionStatus', 'status'],
];

function takeRecord(record, channels, messages, out) {
  if (record.type === 'Channel') {
    channels.set(record.id, { topic: record.topic, kind: '', region: 0 });
    for (const [pattern, , kind] of topics) {
      const match = pattern.exec(record.topic);
      if (match !== null) Object.assign(channels.get(record.id), { kind, region: Number(match[1]) });
    }
  } else if (record.type === 'Message') {
    const channel = channels.get(record.channelId);
    if (channel?.topic === '/world') out.world ??= messages.decode('GetWorldResponse', record.data);
    else if (channel?.kind) {
      // The reader uses its memory again.
      const { kind, region } = channel;
      out.entries.push({ time: record.logTime, tick: 0, region, kind, bytes: record.data.slice() });
    }
  }
}
