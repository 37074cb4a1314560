// The client library against real region servers.
#include "aureole/client.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <functional>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "client/src/push_sender.h"
#include "server/control/world_file.h"
#include "tests/e2e/running_world.h"

namespace aureole {
namespace {

using client::Body;
using client::Client;
using client::Push;
using namespace std::chrono_literals;

using Play = std::function<void(const std::vector<std::string>& endpoints)>;

void RunDemo(const Play& play) {
  absl::StatusOr<WorldFile> file = OpenWorldFile(AUREOLE_WORLDS "/demo.json", {});
  ASSERT_TRUE(file.ok()) << file.status();
  PlayIn(file->spec, file->world.layout.size(), play);
}

std::unique_ptr<Client> Connected(const std::string& server) {
  std::unique_ptr<Client> out;
  const client::Status s = Client::Connect(server, &out);
  EXPECT_TRUE(s.ok()) << s.message;
  return out;
}

const Body* Find(const std::vector<Body>& bodies, uint64_t id) {
  const auto it = std::find_if(bodies.begin(), bodies.end(), [id](const Body& b) { return b.id == id; });
  return it == bodies.end() ? nullptr : &*it;
}

TEST(Client, ShowsTheWholeWorldOverStreamsThatHold) {
  RunDemo([](const std::vector<std::string>& endpoints) {
    const std::unique_ptr<Client> client = Connected(endpoints[2]);
    ASSERT_NE(client, nullptr);
    EXPECT_EQ(client->world().name, "demo");
    EXPECT_EQ(client->world().regions.size(), 4u);
    ASSERT_TRUE(client->Watch({}).ok());
    ASSERT_TRUE(client->WaitUntilComplete(10));
    std::vector<Body> bodies;
    int64_t first = 0, tick = 0;
    client->Latest(&bodies, &first);
    ASSERT_GT(bodies.size(), 200u);
    std::set<int> regions;
    for (const Body& b : bodies) {
      regions.insert(b.region);
      EXPECT_TRUE(client->LookOf(b.id).has_value()) << b.id;
    }
    EXPECT_GE(regions.size(), 2u);
    for (const auto end = std::chrono::steady_clock::now() + 10s;
         tick < first + 120 && std::chrono::steady_clock::now() < end;) {
      std::this_thread::sleep_for(10ms);
      client->Latest(&bodies, &tick);
    }
    EXPECT_GE(tick, first + 120);
    EXPECT_EQ(client->counts().lost_connections, 0);
  });
}

TEST(Client, PushesActOnceHoweverOftenTheConnectionIsCut) {
  static constexpr int kBodies = 16, kPushes = 20000;
  static constexpr double kPush = 1.0 / 1024;  // m/s: sums are exact
  PlayIn(Lanes(kBodies), 3, [](const std::vector<std::string>& endpoints) {
    client::PushSender sender(endpoints, 99);
    std::vector<double> expected(kBodies, 0);
    for (int n = 0; n < kPushes; ++n) {
      Push push;
      push.body = static_cast<uint64_t>(1 + n * 7 % kBodies);
      push.kind = Push::Kind::kVelocityChange;
      push.linear.y = kPush;
      expected[push.body - 1] += kPush;
      sender.Send(push);
      if (n % 400 != 399) continue;  // 50 times, in the middle of a burst
      std::this_thread::sleep_for(20ms);
      sender.Cut();
    }
    ASSERT_TRUE(sender.Flush(60));
    const client::PushCounts counts = sender.counts();
    EXPECT_EQ(counts.rejected, 0) << counts.reasons[0].first;
    EXPECT_EQ(counts.applied, int64_t{kPushes});

    const std::unique_ptr<Client> client = Connected(endpoints[0]);
    client::WatchOptions exact;
    exact.precision = client::Precision::kExact;
    ASSERT_TRUE(client->Watch(exact).ok());
    ASSERT_TRUE(client->WaitUntilComplete(10));
    std::vector<Body> bodies;
    client->Latest(&bodies);
    ASSERT_EQ(bodies.size(), size_t{kBodies});
    std::set<int> regions;
    for (const Body& b : bodies) {
      EXPECT_EQ(b.velocity.y, expected[b.id - 1]) << b.id;
      regions.insert(b.region);
    }
    EXPECT_GE(regions.size(), 2u) << "they crossed the borders meanwhile";
  });
}

TEST(Client, SpawnsPushesAndRemovesABodyThatItSees) {
  PlayIn(Lanes(4), 3, [](const std::vector<std::string>& endpoints) {
    const std::unique_ptr<Client> client = Connected(endpoints[1]);
    ASSERT_TRUE(client->Watch({}).ok());
    client::NewBody box;
    box.shape.kind = client::Shape::Kind::kBox;
    box.shape.size = {1, 2, 3};
    box.mass = 7;
    box.position = {-4.9, 20, 0};
    std::vector<uint64_t> ids;
    client::Status s = client->Spawn({box}, &ids);
    ASSERT_TRUE(s.ok()) << s.message;
    ASSERT_EQ(ids.size(), 1u);
    std::vector<Body> bodies;
    const auto wait_for = [&](auto condition) {
      for (const auto end = std::chrono::steady_clock::now() + 10s; std::chrono::steady_clock::now() < end;) {
        client->Latest(&bodies);
        if (condition()) return true;
        std::this_thread::sleep_for(5ms);
      }
      return false;
    };
    ASSERT_TRUE(wait_for([&] { return Find(bodies, ids[0]) != nullptr; }));
    const std::optional<client::Look> look = client->LookOf(ids[0]);
    ASSERT_TRUE(look.has_value());
    EXPECT_EQ(look->mass, 7);
    EXPECT_EQ(look->shape.kind, client::Shape::Kind::kBox);
    EXPECT_EQ(look->shape.size.z, 3);
    Push push;
    push.sphere = client::Sphere{{-4.9, 20, 0}, 2};
    push.linear = {0, 14, 0};
    client->Do(push);
    client::PushCounts counts;
    ASSERT_TRUE(client->Flush(10, &counts).ok());
    EXPECT_EQ(counts.bodies, 1);
    EXPECT_TRUE(wait_for([&] { return Find(bodies, ids[0]) != nullptr && Find(bodies, ids[0])->position.y > 21; }));
    push.kind = Push::Kind::kForce;
    for (double seconds : {1.0 / 60, 1.4}) {  // no whole numbers of nanoseconds
      push.seconds = seconds;
      client->Do(push);
    }
    ASSERT_TRUE(client->Flush(10, &counts).ok());
    EXPECT_EQ(counts.applied, 3);
    EXPECT_EQ(counts.rejected, 0);
    int64_t removed = 0;
    EXPECT_TRUE(client->Remove({ids[0], 4711}, &removed).ok());
    EXPECT_EQ(removed, 1);
    EXPECT_TRUE(wait_for([&] { return Find(bodies, ids[0]) == nullptr; }));
    EXPECT_FALSE(client->LookOf(ids[0]).has_value());

    box.mass = -1;
    s = client->Spawn({box}, &ids);
    EXPECT_EQ(s.code, 3);
    EXPECT_EQ(s.reason, "BAD_VALUE");
    EXPECT_EQ(s.field, "bodies[0].mass");
    push.seconds = 0;  // a force needs a duration
    client->Do(push);
    ASSERT_TRUE(client->Flush(10, &counts).ok());
    EXPECT_EQ(counts.rejected, 1);
    ASSERT_EQ(counts.reasons.size(), 1u);
    EXPECT_EQ(counts.reasons[0].first, "BAD_VALUE");
  });
}

TEST(Client, SamplesMoveSmoothlyAcrossBorders) {
  PlayIn(Lanes(4), 3, [](const std::vector<std::string>& endpoints) {
    const std::unique_ptr<Client> client = Connected(endpoints[0]);
    ASSERT_TRUE(client->Watch({}).ok());
    ASSERT_TRUE(client->WaitUntilComplete(10));
    std::this_thread::sleep_for(500ms);
    std::vector<Body> bodies;
    std::set<int> regions;
    double last = 0, least = 1e9, most = -1e9;
    auto at = std::chrono::steady_clock::now();
    for (int n = 0; n < 400; ++n) {
      std::this_thread::sleep_for(8ms);
      client->Sample(&bodies);
      const auto now = std::chrono::steady_clock::now();
      const double seconds = std::chrono::duration<double>(now - std::exchange(at, now)).count();
      const Body* b = Find(bodies, 1);
      ASSERT_NE(b, nullptr) << "it flickers";
      regions.insert(b->region);
      const double speed = (b->position.x - std::exchange(last, b->position.x)) / seconds;
      if (n < 10) continue;
      least = std::min(least, speed);
      most = std::max(most, speed);
    }
    EXPECT_GE(regions.size(), 2u);
    EXPECT_GT(least, 0) << "never backwards";
    EXPECT_LT(most, 3 * 4) << "never in jumps";
  });
}

TEST(Client, ViewShowsAPartAndFollows) {
  RunDemo([](const std::vector<std::string>& endpoints) {
    const std::unique_ptr<Client> client = Connected(endpoints[0]);
    client::WatchOptions options;
    options.rect = client::Rect{-60, -40, -60, -40};
    ASSERT_TRUE(client->Watch(options).ok());
    ASSERT_TRUE(client->WaitUntilComplete(10));
    std::vector<Body> bodies;
    client->Latest(&bodies);
    const size_t few = bodies.size();
    options.rect.reset();
    ASSERT_TRUE(client->Watch(options).ok());
    for (const auto end = std::chrono::steady_clock::now() + 10s;
         bodies.size() < 200 && std::chrono::steady_clock::now() < end;) {
      std::this_thread::sleep_for(10ms);
      client->Latest(&bodies);
    }
    EXPECT_GE(bodies.size(), 200u);
    EXPECT_LT(few, 100u);
    EXPECT_EQ(client->counts().lost_connections, 0) << "the streams are the same";
    options.rate = -1;
    EXPECT_EQ(client->Watch(options).field, "rate");
  });
}

TEST(Client, ServerThatDoesNotAnswerIsNamedInTime) {
  std::unique_ptr<Client> client;
  const client::Status s = Client::Connect("127.0.0.1:1", &client, 0.3);
  EXPECT_FALSE(s.ok());
  EXPECT_EQ(client, nullptr);
}

}  // namespace
}  // namespace aureole
