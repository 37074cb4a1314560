// The inputs of one browser: pushes over one stream, spawns and removals one at a time. Each acts once, however often
// connections are lost.
import crypto from 'node:crypto';
import { status } from './rpc.js';

const mostUnsettled = 5000;  // pushes; of so many the servers know what became of them
const batchSize = 1024;
const retry = 250;           // ms
const callSeconds = 10;

function randomClient() {
  return (crypto.randomBytes(8).readBigUInt64LE() | 1n).toString();
}

export class Inputs {
  // `endpoints()`: where the servers are now. `settled({ sequence, tick, bodies, reason })`: what became of a push.
  constructor({ rpc, endpoints, settled }) {
    Object.assign(this, { rpc, endpoints, settled });
    this.client = randomClient();
    this.sequence = 0;
    this.unsettled = new Map();  // by sequence, in order
    this.stream = null;
    this.serving = '';  // where the stream goes
    this.server = 0;
    this.timer = null;
    this.ended = false;
    // Spawns and removals have a client of their own: they may go through another server than the pushes.
    this.callsClient = randomClient();
    this.callsSequence = 0;
    this.calls = Promise.resolve();
  }

  // Returns its sequence; 0 when there are too many on the way.
  push(impulse) {
    if (this.unsettled.size >= mostUnsettled) return 0;
    const sequence = ++this.sequence;
    const entry = { ...impulse, sequence };
    this.unsettled.set(sequence, entry);
    if (this.stream !== null) this.stream.write({ inputs: { impulse: [entry] } });
    else if (this.timer === null) this.#open();
    return sequence;
  }

  // The decoded answer. `count`: how many sequences it takes.
  call(method, request, count) {
    const sequence = this.callsSequence + 1;
    this.callsSequence += count;
    const answer = this.calls.then(() => this.#repeat(method, { ...request, client: this.callsClient, sequence }));
    this.calls = answer.catch(() => {});
    return answer;
  }

  // The servers have changed: a stream to one that is none any more is given up, and what it has not settled is repeated.
  follow() {
    if (!this.endpoints().includes(this.serving)) this.stream?.cancel();
  }

  close() {
    this.ended = true;
    clearTimeout(this.timer);
    this.stream?.cancel();
  }

  #open() {
    this.timer = null;
    const endpoints = this.endpoints();
    if (endpoints.length === 0) return this.#openLater();
    this.serving = endpoints[this.server % endpoints.length];
    const stream = (this.stream = this.rpc.play(this.serving));
    stream.on('data', (bytes) => this.#settle(this.rpc.decode('PlayResponse', bytes).outcomes));
    stream.on('error', () => {});
    stream.on('status', (result) => {
      this.stream = null;
      if (this.ended) return;
      // What is wrong ends the stream. It would do so again.
      if (result.code === status.INVALID_ARGUMENT) this.#giveUp(result.details);
      else ++this.server;
      if (this.unsettled.size > 0) this.#openLater();
    });
    const waiting = [...this.unsettled.values()];
    for (let i = 0; i < Math.max(1, waiting.length); i += batchSize) {
      stream.write({ inputs: { client: this.client, impulse: waiting.slice(i, i + batchSize) } });
    }
  }

  #openLater() {
    this.timer = setTimeout(() => this.#open(), retry);
  }

  #settle(outcomes) {
    if (!outcomes) return;
    outcomes.sequence.forEach((sequence, i) => {
      if (!this.unsettled.delete(Number(sequence))) return;
      const reason = outcomes.reason[i] ?? 'REASON_UNSPECIFIED';
      this.settled({
        sequence: Number(sequence), tick: Number(outcomes.tick[i] ?? 0), bodies: Number(outcomes.bodies[i] ?? 0),
        reason: reason === 'REASON_UNSPECIFIED' ? '' : String(reason),
      });
    });
  }

  #giveUp(reason) {
    const sequences = [...this.unsettled.keys()];
    this.unsettled.clear();
    for (const sequence of sequences) this.settled({ sequence, tick: 0, bodies: 0, reason });
  }

  // At one server after the other until it is answered: a repetition acts once.
  async #repeat(method, request) {
    const end = Date.now() + callSeconds * 1000;
    for (let server = 0; ; ++server) {
      const endpoints = this.endpoints();
      try {
        if (endpoints.length === 0) throw Object.assign(new Error('no server is known'), { code: status.UNAVAILABLE });
        const bytes = await this.rpc.call(endpoints[server % endpoints.length], method, request, callSeconds);
        return this.rpc.decode(`${method}Response`, bytes);
      } catch (error) {
        const again = error.code === status.UNAVAILABLE || error.code === status.CANCELLED;
        if (!again || this.ended || Date.now() + retry >= end) throw error;
        await new Promise((resolve) => setTimeout(resolve, retry));
      }
    }
  }
}
