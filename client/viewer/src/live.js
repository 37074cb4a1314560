// The connection to the gateway.

const kinds = { frame: 1, status: 2, world: 3, layout: 4 };
const retryMs = 1000;

export class Live {
  // `on`: world(message), layout(message, regions whose streams have ended), begin(region), frame(region, message, bytes), status(region, message), link(region, up, text),
  // connection(up, text) to the gateway, waiting(text) for a world, outcome(message), error(text).
  constructor(messages, on) {
    this.messages = messages;
    this.on = on;
    this.socket = null;
    this.ended = false;
    this.calls = new Map();  // by number
    this.lastCall = 0;
    this.begun = new Set();  // regions whose stream is being read
    this.endpoints = [];     // of the layout, by region
    this.auras = false;
    this.#open();
  }

  close() {
    this.ended = true;
    clearTimeout(this.timer);
    this.socket?.close();
    this.#forgetCalls('closed');
  }

  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  // The gateway's answer. Rejects with what went wrong.
  call(message) {
    const call = ++this.lastCall;
    return new Promise((resolve, reject) => {
      if (!this.send({ ...message, call })) return reject(new Error('there is no connection'));
      this.calls.set(call, { resolve, reject });
      return undefined;
    });
  }

  setAuras(on) {
    this.auras = on;
    this.send({ type: 'auras', on });
  }

  #open() {
    const url = new URL('socket', window.location.href);
    url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
    url.search = url.hash = '';
    const socket = (this.socket = new WebSocket(url));
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => {
      this.on.connection(true, '');
      if (this.auras) this.setAuras(true);
    };
    socket.onmessage = ({ data }) => {
      if (typeof data === 'string') this.#takeText(JSON.parse(data));
      else this.#takeBytes(new Uint8Array(data));
    };
    socket.onclose = () => {
      if (this.ended) return;
      this.begun.clear();
      this.#forgetCalls('the connection was lost');
      this.on.connection(false, 'the gateway does not answer');
      this.timer = setTimeout(() => this.#open(), retryMs);
    };
  }

  #forgetCalls(reason) {
    for (const { reject } of this.calls.values()) reject(new Error(reason));
    this.calls.clear();
  }

  #takeText(message) {
    if (message.type === 'link') {
      this.begun.delete(message.region);
      if (message.up) this.#begin(message.region);
      this.on.link(message.region, message.up, message.message ?? '');
    } else if (message.type === 'waiting') this.on.waiting(message.message);
    else if (message.type === 'outcome') this.on.outcome(message);
    else if (message.type === 'error') this.on.error(message.message);
    else if (message.type === 'answer') this.#settle(message);
  }

  #settle(message) {
    const call = this.calls.get(message.call);
    this.calls.delete(message.call);
    if (message.ok) call?.resolve(message);
    else call?.reject(new Error(message.message));
  }

  #begin(region) {
    this.begun.add(region);
    this.on.begin(region);
  }

  #takeBytes(bytes) {
    const region = bytes[2] | (bytes[3] << 8);
    const body = bytes.subarray(4);
    if (bytes[0] === kinds.world) {
      const world = this.messages.decode('GetWorldResponse', body);
      this.begun.clear();
      this.endpoints = world.endpoints;
      this.on.world(world);
      this.on.connection(true, '');
    } else if (bytes[0] === kinds.layout) {
      this.#takeLayout(this.messages.decode('GetWorldResponse', body));
    } else if (bytes[0] === kinds.status) {
      const { status } = this.messages.decode('LayoutUpdate', body);
      if (status !== null) this.on.status(region, status);
    } else if (bytes[0] === kinds.frame && this.begun.has(region)) this.#takeFrame(region, body);
  }

  // Frames of servers that are elsewhere, or nowhere, come no more.
  #takeLayout(world) {
    const ended = [...this.endpoints.keys()].filter((region) => world.endpoints[region] !== this.endpoints[region]);
    for (const region of ended) this.begun.delete(region);
    this.endpoints = world.endpoints;
    this.on.layout(world, ended);
  }

  #takeFrame(region, body) {
    try {
      const { frame } = this.messages.decode('PlayResponse', body);
      if (frame === null) return;
      this.on.frame(region, frame, body.length);
      this.#acknowledge(region, frame.tick);
    } catch (error) {
      // What cannot be read is begun anew.
      this.begun.delete(region);
      this.on.error(`region ${region}: ${error.message}`);
      this.send({ type: 'restart', region });
    }
  }

  #acknowledge(region, tick) {
    const view = new DataView(new ArrayBuffer(12));
    view.setUint8(0, kinds.frame);
    view.setUint16(2, region, true);
    view.setFloat64(4, tick, true);
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(view.buffer);
  }
}
