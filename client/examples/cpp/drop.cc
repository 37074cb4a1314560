// Drops a ball into a running world, watches it fall, pushes it, and takes it away again.
//
//   drop HOST:PORT      (any region server; aureole up names them)
#include <aureole/client.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <memory>
#include <thread>
#include <vector>

using namespace aureole::client;

namespace {

bool Failed(const Status& status, const char* what) {
  if (!status.ok()) std::fprintf(stderr, "drop: %s: %s\n", what, status.message.c_str());
  return !status.ok();
}

// The newest state of one body; false while it is not in view.
bool Find(const Client& client, uint64_t id, Body* out) {
  std::vector<Body> bodies;
  client.Latest(&bodies);
  for (const Body& b : bodies) {
    if (b.id == id) *out = b;
    if (b.id == id) return true;
  }
  return false;
}

// Waits until the body is as wanted, at most ten seconds.
template <class Condition>
bool WaitFor(const Client& client, uint64_t id, Condition condition) {
  Body body;
  for (int i = 0; i < 1000; ++i) {
    if (Find(client, id, &body) && condition(body)) return true;
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  return false;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: drop HOST:PORT\n");
    return 2;
  }
  std::unique_ptr<Client> client;
  if (Failed(Client::Connect(argv[1], &client), "connect")) return 1;
  if (Failed(client->Watch({}), "watch")) return 1;
  if (!client->WaitUntilComplete(10)) return 1;

  NewBody ball;
  ball.shape.kind = Shape::Kind::kSphere;
  ball.shape.radius = 0.5;
  ball.mass = 5;
  ball.position = {0, 60, 0};
  std::vector<uint64_t> ids;
  if (Failed(client->Spawn({ball}, &ids), "spawn")) return 1;
  if (!WaitFor(*client, ids[0], [](const Body& b) { return b.velocity.y < -1; })) return 1;

  Push push;
  push.body = ids[0];
  push.kind = Push::Kind::kVelocityChange;
  push.linear = {0, 40, 0};
  client->Do(push);
  PushCounts counts;
  if (Failed(client->Flush(10, &counts), "push")) return 1;
  if (!WaitFor(*client, ids[0], [](const Body& b) { return b.velocity.y > 1; })) return 1;

  Body body;
  Find(*client, ids[0], &body);
  std::printf("world %s, %zu servers: ball %llu is at height %.1f m on server %d after %lld push\n",
              client->world().name.c_str(), client->world().regions.size(), static_cast<unsigned long long>(ids[0]),
              body.position.y, body.region, static_cast<long long>(counts.applied));
  int64_t removed = 0;
  return Failed(client->Remove(ids, &removed), "remove") || removed != 1 ? 1 : 0;
}
