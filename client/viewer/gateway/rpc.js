// Calls to region servers. Answers are bytes, since most of them only pass through.
import grpc from '@grpc/grpc-js';

const channelOptions = {
  'grpc.max_receive_message_length': -1,
  'grpc.max_send_message_length': -1,
  'grpc.initial_reconnect_backoff_ms': 100,
  'grpc.max_reconnect_backoff_ms': 1000,
  'grpc.enable_http_proxy': 0,
};

const path = (method) => `/aureole.v1.Simulation/${method}`;
const asIs = (bytes) => bytes;

export const status = grpc.status;

// What went wrong, for people: without what grpc-js adds around a refused connection.
export function textOf(error) {
  const text = error.details || error.message || status[error.code] || '';
  return text.replace(/^No connection established\. Last error: (Error: )?/, '').replace(/\.? ?Resolution note:.*$/, '');
}

export class Rpc {
  constructor(root) {
    this.root = root;
    this.clients = new Map();  // by endpoint
  }

  encoder(type) {
    const message = this.root.lookupType(`aureole.v1.${type}`);
    return (object) => Buffer.from(message.encode(message.fromObject(object)).finish());
  }

  // 64-bit numbers become strings, enums their names.
  decode(type, bytes) {
    const message = this.root.lookupType(`aureole.v1.${type}`);
    return message.toObject(message.decode(bytes), { longs: String, enums: String, defaults: true });
  }

  // The bytes of the answer, or an error with gRPC's `code` and `details`.
  call(endpoint, method, request, seconds) {
    const deadline = new Date(Date.now() + seconds * 1000);
    return new Promise((resolve, reject) => {
      this.#client(endpoint).makeUnaryRequest(path(method), this.encoder(`${method}Request`), asIs, request,
        new grpc.Metadata(), { deadline }, (error, bytes) => (error ? reject(error) : resolve(bytes)));
    });
  }

  // A two-way stream of PlayRequests and the bytes of PlayResponses.
  play(endpoint) {
    return this.#client(endpoint).makeBidiStreamRequest(path('Play'), this.encoder('PlayRequest'), asIs);
  }

  // A stream of the bytes of LayoutUpdates.
  watchLayout(endpoint, request) {
    const encode = this.encoder('WatchLayoutRequest');
    return this.#client(endpoint).makeServerStreamRequest(path('WatchLayout'), encode, asIs, request);
  }

  // Ends all connections, and with them the calls on them.
  close() {
    for (const client of this.clients.values()) client.close();
    this.clients.clear();
  }

  #client(endpoint) {
    let client = this.clients.get(endpoint);
    if (client === undefined) {
      client = new grpc.Client(endpoint, grpc.credentials.createInsecure(), channelOptions);
      this.clients.set(endpoint, client);
    }
    return client;
  }
}
