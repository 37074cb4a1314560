#include "aureole/client.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <limits>
#include <map>
#include <mutex>
#include <random>
#include <thread>
#include <unordered_map>

#include "aureole/v1/simulation.grpc.pb.h"
#include "client/src/channel.h"
#include "client/src/convert.h"
#include "client/src/layout_follower.h"
#include "client/src/push_sender.h"
#include "client/src/region_watch.h"
#include "client/src/replica_merger.h"

namespace aureole::client {
namespace {

using Clock = std::chrono::steady_clock;

constexpr double kLongestExtrapolation = 0.25;  // s
// A step of the servers' time against ours that is followed at once; smaller ones are smoothed.
constexpr double kJump = 0.25;  // s
constexpr double kSmoothing = 0.05;
constexpr std::chrono::milliseconds kAskAgain(50);

uint64_t RandomClient() {
  std::random_device device;
  return (uint64_t{device()} << 32 | device()) | 1;
}

double Seconds(Clock::time_point t) { return std::chrono::duration<double>(t.time_since_epoch()).count(); }

std::chrono::system_clock::time_point Deadline(double seconds) {
  return std::chrono::system_clock::now() +
         std::chrono::duration_cast<std::chrono::system_clock::duration>(std::chrono::duration<double>(seconds));
}

Vec3 ToVec3(const std::array<double, 3>& v) { return {v[0], v[1], v[2]}; }

Body BodyFrom(uint64_t id, const MergedBody& b) {
  const auto& q = b.state.orientation;
  return {id,
          ToVec3(b.state.position),
          {q[0], q[1], q[2], q[3]},
          ToVec3(b.state.velocity),
          ToVec3(b.state.angular_velocity),
          b.region,
          b.state.asleep};
}

Vec3 Between(const std::array<double, 3>& a, const std::array<double, 3>& b, double t) {
  return {a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t};
}

Quaternion Normalised(Quaternion q) {
  const double n = std::sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
  return n > 0 ? Quaternion{q.x / n, q.y / n, q.z / n, q.w / n} : Quaternion{};
}

// Along the shorter way; close enough to the arc for the small turns between frames.
Quaternion Between(const std::array<double, 4>& a, const std::array<double, 4>& b, double t) {
  const double dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const double s = dot < 0 ? -t : t;
  return Normalised(
      {a[0] * (1 - t) + b[0] * s, a[1] * (1 - t) + b[1] * s, a[2] * (1 - t) + b[2] * s, a[3] * (1 - t) + b[3] * s});
}

// Turned by the angular velocity for a time.
Quaternion Turned(const std::array<double, 4>& q, const std::array<double, 3>& w, double dt) {
  const double speed = std::sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
  if (speed == 0) return {q[0], q[1], q[2], q[3]};
  const double half = speed * dt / 2, s = std::sin(half) / speed, c = std::cos(half);
  const double x = w[0] * s, y = w[1] * s, z = w[2] * s;
  return Normalised({c * q[0] + x * q[3] + y * q[2] - z * q[1], c * q[1] - x * q[2] + y * q[3] + z * q[0],
                     c * q[2] + x * q[1] - y * q[0] + z * q[3], c * q[3] - x * q[0] - y * q[1] - z * q[2]});
}

// A body at simulated time `tick`, which may be a fraction.
Body At(uint64_t id, const MergedBody& b, double tick, double tick_seconds) {
  Body out = BodyFrom(id, b);
  const auto now = static_cast<double>(b.tick);
  if (tick >= now) {
    if (b.state.asleep) return out;
    const double dt = std::min((tick - now) * tick_seconds, kLongestExtrapolation);
    out.position.x += out.velocity.x * dt;
    out.position.y += out.velocity.y * dt;
    out.position.z += out.velocity.z * dt;
    out.orientation = Turned(b.state.orientation, b.state.angular_velocity, dt);
    return out;
  }
  const ToldBody* later = &b.state;
  double later_tick = now;
  for (const MergedBody::Before& before : b.before) {
    if (before.tick == 0) break;
    const auto earlier_tick = static_cast<double>(before.tick);
    const double t = std::clamp((tick - earlier_tick) / std::max(later_tick - earlier_tick, 1e-9), 0.0, 1.0);
    out.position = Between(before.state.position, later->position, t);
    out.orientation = Between(before.state.orientation, later->orientation, t);
    if (tick >= earlier_tick) break;
    later = &before.state;
    later_tick = earlier_tick;
  }
  return out;
}

}  // namespace

struct Client::Impl {
  Impl(const std::string& server, const v1::GetWorldResponse& told, Access a)
      : tick_seconds(WorldFrom(told).tick_seconds),
        access(std::move(a)),
        pushes(EndpointsOf(told), RandomClient(), access),
        calls_client(RandomClient()),
        world(WorldFrom(told)),
        follower(server, told, access, [this](const v1::GetWorldResponse& now) { TakeLayout(now); }) {}

  World Layout() const;
  void TakeLayout(const v1::GetWorldResponse& told);
  void FollowStreams();
  void FollowWatches(const World& now);
  void OnFrame(int32_t region, const v1::ReplicaFrame& frame, const ReplicaDecoder& decoder, bool fresh);
  void Follow(int64_t tick);
  int64_t OldestTick() const;
  grpc::Status CastRays(const World& now, const v1::CastRaysRequest& request,
                        std::chrono::system_clock::time_point deadline, v1::CastRaysResponse* nearest) const;
  template <class Request, class Response>
  Status Call(grpc::Status (v1::Simulation::Stub::*method)(grpc::ClientContext*, const Request&, Response*),
              const Request& request, Response* response, double timeout_seconds);

  const double tick_seconds;
  const Access access;
  PushSender pushes;

  // Spawns and removals, one at a time.
  const uint64_t calls_client;
  std::mutex calls_mutex;
  uint64_t calls_sequence = 0;

  mutable std::mutex mutex;
  mutable std::condition_variable changed;
  World world;  // by the newest layout
  ReplicaMerger merger;
  std::unordered_map<uint64_t, std::shared_ptr<const Look>> looks;
  struct Stream {
    int64_t tick = 0;
    std::string endpoint;
    bool complete = false;
    double real_time_factor = 1;
  };
  std::map<int32_t, Stream> streams;  // by region: those of the layout, once anything is watched
  Counts counts;
  // Simulated time of the servers less ours, s.
  double offset = std::numeric_limits<double>::quiet_NaN();
  int64_t newest = 0;

  std::mutex watches_mutex;  // before `mutex`
  std::optional<v1::StreamReplicasRequest> wanted;
  std::map<int32_t, std::unique_ptr<RegionWatch>> watches;  // ends before what its frames go to

  LayoutFollower follower;  // last: ends first
};

World Client::Impl::Layout() const {
  const std::lock_guard lock(mutex);
  return world;
}

// The follower's thread.
void Client::Impl::TakeLayout(const v1::GetWorldResponse& told) {
  pushes.Follow(EndpointsOf(told));
  const World now = WorldFrom(told);
  const std::lock_guard watching(watches_mutex);
  // No frame comes of a region once it is known to be elsewhere, or nowhere.
  std::erase_if(watches, [&](const auto& w) {
    const auto region = static_cast<size_t>(w.first);
    return region >= now.regions.size() || now.regions[region].endpoint != w.second->endpoint();
  });
  {
    const std::lock_guard lock(mutex);
    world = now;
    if (!streams.empty()) FollowStreams();
  }
  changed.notify_all();
  if (wanted.has_value()) FollowWatches(now);
}

// Holds the mutex. What a region that comes will tell first, another one has told until now.
void Client::Impl::FollowStreams() {
  const int64_t oldest = OldestTick();
  std::vector<int32_t> regions;
  for (size_t r = 0; r < world.regions.size(); ++r) {
    if (!world.regions[r].endpoint.empty()) regions.push_back(static_cast<int32_t>(r));
  }
  std::map<int32_t, Stream> now;
  for (int32_t r : regions) {
    const auto known = streams.find(r);
    Stream& stream = now[r];
    if (known != streams.end()) {
      stream = known->second;
    } else {
      stream.tick = oldest;
    }
    const std::string& endpoint = world.regions[static_cast<size_t>(r)].endpoint;
    if (std::exchange(stream.endpoint, endpoint) != endpoint) stream.complete = false;
  }
  streams = std::move(now);
  merger.Follow(world.layout_epoch, regions);
}

// Holds the watches' mutex. A stream to each region that has none.
void Client::Impl::FollowWatches(const World& now) {
  for (size_t r = 0; r < now.regions.size(); ++r) {
    const auto region = static_cast<int32_t>(r);
    if (now.regions[r].endpoint.empty() || watches.contains(region)) continue;
    RegionWatch::Events events;
    events.frame = [this, region](const v1::ReplicaFrame& frame, const ReplicaDecoder& decoder, bool fresh) {
      OnFrame(region, frame, decoder, fresh);
    };
    events.connection = [this](bool up) {
      const std::lock_guard lock(mutex);
      ++(up ? counts.connections : counts.lost_connections);
    };
    watches[region] = std::make_unique<RegionWatch>(now.regions[r].endpoint, access, *wanted, std::move(events));
  }
}

void Client::Impl::OnFrame(int32_t region, const v1::ReplicaFrame& frame, const ReplicaDecoder& decoder, bool fresh) {
  const std::lock_guard lock(mutex);
  for (const v1::BodyDescription& d : frame.described()) {
    const auto look = std::make_shared<const Look>(LookFrom(d));
    uint64_t id = 0;
    for (uint64_t step : d.body()) looks[id += step] = look;
  }
  merger.Apply(region, decoder, frame);
  Stream& stream = streams[region];
  stream.tick = decoder.tick();
  stream.real_time_factor = frame.real_time_factor();
  if (fresh) {
    stream.complete = true;
    changed.notify_all();
  }
  for (const LostBody& l : merger.lost()) looks.erase(l.body);
  ++counts.frames;
  counts.bytes += static_cast<int64_t>(frame.ByteSizeLong());
  Follow(decoder.tick());
}

void Client::Impl::Follow(int64_t tick) {
  if (tick <= newest) return;
  newest = tick;
  const double now = static_cast<double>(tick) * tick_seconds - Seconds(Clock::now());
  if (std::isnan(offset) || std::abs(now - offset) > kJump) {
    offset = now;
  } else {
    offset += kSmoothing * (now - offset);
  }
}

int64_t Client::Impl::OldestTick() const {
  int64_t oldest = std::numeric_limits<int64_t>::max();
  for (const auto& [region, s] : streams) oldest = std::min(oldest, s.tick);
  return streams.empty() ? 0 : oldest;
}

// At one server after the other until it is answered: a repetition acts once.
template <class Request, class Response>
Status Client::Impl::Call(grpc::Status (v1::Simulation::Stub::*method)(grpc::ClientContext*, const Request&, Response*),
                          const Request& request, Response* response, double timeout_seconds) {
  const auto deadline = Deadline(timeout_seconds);
  for (size_t server = 0;; ++server) {
    const World now = Layout();
    const std::string& endpoint = now.regions[server % now.regions.size()].endpoint;
    if (endpoint.empty()) continue;  // another one is there
    const auto stub = v1::Simulation::NewStub(ChannelTo(endpoint, access));
    grpc::ClientContext context;
    context.set_deadline(deadline);
    response->Clear();
    const grpc::Status s = (stub.get()->*method)(&context, request, response);
    const bool retry = s.error_code() == grpc::StatusCode::UNAVAILABLE || s.error_code() == grpc::StatusCode::CANCELLED;
    if (!retry || std::chrono::system_clock::now() + 2 * kAskAgain >= deadline) return FromGrpc(s);
    std::this_thread::sleep_for(kAskAgain);
  }
}

// Bodies may be on other servers than their place says, so all are asked, at once. UNAVAILABLE: there may be others.
grpc::Status Client::Impl::CastRays(const World& now, const v1::CastRaysRequest& request,
                                    std::chrono::system_clock::time_point deadline,
                                    v1::CastRaysResponse* nearest) const {
  struct Answer {
    v1::CastRaysResponse response;
    grpc::Status status;
  };
  std::vector<Answer> answers(now.regions.size());
  std::vector<std::thread> threads;
  for (size_t i = 0; i < answers.size(); ++i) {
    if (now.regions[i].endpoint.empty()) continue;
    threads.emplace_back([&, i] {
      const auto stub = v1::Simulation::NewStub(ChannelTo(now.regions[i].endpoint, access));
      grpc::ClientContext context;
      context.set_deadline(deadline);
      answers[i].status = stub->CastRays(&context, request, &answers[i].response);
    });
  }
  for (std::thread& t : threads) t.join();
  nearest->add_hits();
  for (const Answer& a : answers) {
    if (!a.status.ok()) return a.status;
    if (a.response.hits_size() == 0) continue;  // was not asked: the region has left
    if (a.response.layout_epoch() > now.layout_epoch) {
      return {grpc::StatusCode::UNAVAILABLE, "the layout has changed, and the new one is not known yet"};
    }
    const v1::CastRaysResponse::Hit& h = a.response.hits(0);
    const v1::CastRaysResponse::Hit& least = nearest->hits(0);
    if (h.body() != 0 && (least.body() == 0 || h.distance() < least.distance())) *nearest->mutable_hits(0) = h;
  }
  return grpc::Status::OK;
}

Status Client::Connect(const std::string& server, std::unique_ptr<Client>* client, double timeout_seconds,
                       const Access& access) {
  const auto stub = v1::Simulation::NewStub(ChannelTo(server, access));
  grpc::ClientContext context;
  context.set_deadline(Deadline(timeout_seconds));
  context.set_wait_for_ready(true);
  v1::GetWorldResponse response;
  if (const grpc::Status s = stub->GetWorld(&context, {}, &response); !s.ok()) return FromGrpc(s);
  client->reset(new Client(std::make_unique<Impl>(server, response, access)));
  return {};
}

Client::Client(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Client::~Client() = default;

World Client::world() const { return impl_->Layout(); }

Status Client::Watch(const WatchOptions& options) {
  if (!(options.rate > 0 && options.rate <= 1000)) {
    return {3, "rate: must be above 0 and at most 1000 per second", "BAD_VALUE", "rate"};
  }
  if (options.sphere.has_value() && !(options.sphere->radius > 0)) {
    return {3, "sphere.radius: must be above 0 m", "BAD_VALUE", "sphere.radius"};
  }
  if (options.rect.has_value() &&
      !(options.rect->min_x <= options.rect->max_x && options.rect->min_z <= options.rect->max_z)) {
    return {3, "rect: must not end before it begins", "BAD_VALUE", "rect"};
  }
  const v1::StreamReplicasRequest request = RequestOf(options);
  const std::lock_guard watching(impl_->watches_mutex);
  for (auto& [region, watch] : impl_->watches) watch->Want(request);
  if (std::exchange(impl_->wanted, request).has_value()) return {};
  World now;
  {
    const std::lock_guard lock(impl_->mutex);
    impl_->FollowStreams();
    now = impl_->world;
  }
  impl_->FollowWatches(now);
  return {};
}

bool Client::WaitUntilComplete(double timeout_seconds) const {
  std::unique_lock lock(impl_->mutex);
  return impl_->changed.wait_for(lock, std::chrono::duration<double>(timeout_seconds), [this] {
    return !impl_->streams.empty() &&
           std::all_of(impl_->streams.begin(), impl_->streams.end(), [](const auto& s) { return s.second.complete; });
  });
}

void Client::Latest(std::vector<Body>* bodies, int64_t* tick) const {
  bodies->clear();
  {
    const std::lock_guard lock(impl_->mutex);
    for (const auto& [id, body] : impl_->merger.bodies()) bodies->push_back(BodyFrom(id, body));
    if (tick != nullptr) *tick = impl_->OldestTick();
  }
  std::sort(bodies->begin(), bodies->end(), [](const Body& x, const Body& y) { return x.id < y.id; });
}

void Client::Sample(std::vector<Body>* bodies, double delay_seconds) const {
  bodies->clear();
  {
    const std::lock_guard lock(impl_->mutex);
    const double seconds = Seconds(Clock::now()) + impl_->offset - delay_seconds;
    const double tick = seconds / impl_->tick_seconds;
    for (const auto& [id, body] : impl_->merger.bodies()) bodies->push_back(At(id, body, tick, impl_->tick_seconds));
  }
  std::sort(bodies->begin(), bodies->end(), [](const Body& x, const Body& y) { return x.id < y.id; });
}

std::optional<Look> Client::LookOf(uint64_t body) const {
  const std::lock_guard lock(impl_->mutex);
  const auto it = impl_->looks.find(body);
  return it == impl_->looks.end() ? std::nullopt : std::optional<Look>(*it->second);
}

double Client::real_time_factor() const {
  const std::lock_guard lock(impl_->mutex);
  double least = 1;
  for (const auto& [region, s] : impl_->streams) least = std::min(least, s.real_time_factor);
  return least;
}

Counts Client::counts() const {
  const std::lock_guard lock(impl_->mutex);
  return impl_->counts;
}

void Client::Do(const Push& push) { impl_->pushes.Send(push); }

Status Client::Flush(double timeout_seconds, PushCounts* counts) {
  const bool all = impl_->pushes.Flush(timeout_seconds);
  if (counts != nullptr) *counts = impl_->pushes.counts();
  return all ? Status{} : Status{4, "not all pushes have been settled in time", "", ""};
}

PushCounts Client::pushes() const { return impl_->pushes.counts(); }

Status Client::Spawn(const std::vector<NewBody>& bodies, std::vector<uint64_t>* ids, double timeout_seconds) {
  const std::lock_guard lock(impl_->calls_mutex);
  v1::SpawnBodiesRequest request;
  v1::SpawnBodiesResponse response;
  request.set_client(impl_->calls_client);
  request.set_sequence(impl_->calls_sequence + 1);
  impl_->calls_sequence += bodies.size();
  for (const NewBody& b : bodies) *request.add_bodies() = BodyOf(b);
  const Status s = impl_->Call<v1::SpawnBodiesRequest, v1::SpawnBodiesResponse>(&v1::Simulation::Stub::SpawnBodies,
                                                                                request, &response, timeout_seconds);
  if (ids != nullptr) ids->assign(response.body().begin(), response.body().end());
  return s;
}

// Again, while a server that was asked has left or is coming back, or one that was not asked has come.
Status Client::CastRay(const Vec3& origin, const Vec3& direction, double length, RayHit* hit, double timeout_seconds) {
  v1::CastRaysRequest request;
  v1::CastRaysRequest::Ray* ray = request.add_rays();
  for (const auto& [from, to] :
       {std::pair(origin, ray->mutable_origin()), std::pair(direction, ray->mutable_direction())}) {
    to->set_x(from.x);
    to->set_y(from.y);
    to->set_z(from.z);
  }
  ray->set_length(length);
  const auto deadline = Deadline(timeout_seconds);
  *hit = {};
  while (true) {
    v1::CastRaysResponse nearest;
    const World now = impl_->Layout();
    const grpc::Status s = impl_->CastRays(now, request, deadline, &nearest);
    const bool again = s.error_code() == grpc::StatusCode::UNAVAILABLE;
    if (again && std::chrono::system_clock::now() + kAskAgain < deadline) {
      std::this_thread::sleep_for(kAskAgain);
      continue;
    }
    if (!s.ok()) return FromGrpc(s);
    const v1::CastRaysResponse::Hit& h = nearest.hits(0);
    *hit = {h.body(),
            h.fixed(),
            h.distance(),
            {h.point().x(), h.point().y(), h.point().z()},
            {h.normal().x(), h.normal().y(), h.normal().z()}};
    return {};
  }
}

Status Client::Remove(const std::vector<uint64_t>& bodies, int64_t* removed, double timeout_seconds) {
  const std::lock_guard lock(impl_->calls_mutex);
  v1::RemoveBodiesRequest request;
  v1::RemoveBodiesResponse response;
  request.set_client(impl_->calls_client);
  request.set_sequence(impl_->calls_sequence + 1);
  impl_->calls_sequence += bodies.size();
  request.mutable_body()->Add(bodies.begin(), bodies.end());
  const Status s = impl_->Call<v1::RemoveBodiesRequest, v1::RemoveBodiesResponse>(&v1::Simulation::Stub::RemoveBodies,
                                                                                  request, &response, timeout_seconds);
  if (removed != nullptr) *removed = response.removed();
  return s;
}

}  // namespace aureole::client
