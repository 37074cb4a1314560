#include "server/region/metrics.h"

#include <exception>
#include <map>
#include <mutex>
#include <utility>

#include <absl/strings/str_cat.h>
#include <prometheus/counter.h>
#include <prometheus/exposer.h>
#include <prometheus/gauge.h>
#include <prometheus/histogram.h>
#include <prometheus/registry.h>

namespace aureole {
namespace {

// Seconds; a tick is 16 ms by default.
const prometheus::Histogram::BucketBoundaries kFrameBuckets = {0.0005, 0.001, 0.002, 0.004, 0.008, 0.012,
                                                               0.016,  0.024, 0.032, 0.064, 0.128, 0.256};

}  // namespace

struct RegionMetrics::Impl {
  explicit Impl(const std::string& address) : exposer(address, 1), registry(std::make_shared<prometheus::Registry>()) {
    exposer.RegisterCollectable(registry);
  }

  prometheus::Gauge& Gauge(const char* name, const char* help) {
    return prometheus::BuildGauge().Name(name).Help(help).Register(*registry).Add(labels);
  }
  prometheus::Counter& Counter(const char* name, const char* help, prometheus::Labels more = {}) {
    more.insert(labels.begin(), labels.end());
    return prometheus::BuildCounter().Name(name).Help(help).Register(*registry).Add(more);
  }
  // Brings a counter up to `total`.
  static void Raise(prometheus::Counter* counter, double total) {
    if (total > counter->Value()) counter->Increment(total - counter->Value());
  }

  // Everything that carries the labels of the assignment.
  struct Set {
    prometheus::Gauge &tick, &bodies, &awake, &real_time_factor, &auras, &away, &largest_cluster, &waiting_for;
    prometheus::Histogram &frame, &frame_wall;
    prometheus::Counter &waits, &wait_seconds, &violations, &collisions, &returns, &bodies_moved, &aura_updates;
    prometheus::Counter &bytes, &frames, &reconnects, &refused_frames, &refused_links, &home_crossings;
  };
  prometheus::Histogram& Frames(const char* name, const char* help) {
    return prometheus::BuildHistogram().Name(name).Help(help).Register(*registry).Add(labels, kFrameBuckets);
  }
  std::unique_ptr<Set> MakeSet() {
    const char* transfers = "Clusters of bodies whose ownership this region gave away, by cause.";
    return std::unique_ptr<Set>(new Set{
        Gauge("aureole_tick", "Last tick that was stepped."),
        Gauge("aureole_bodies", "Dynamic bodies that this region owns."),
        Gauge("aureole_bodies_awake", "Of these, awake."),
        Gauge("aureole_real_time_factor", "Simulated over wall time since the last report; 1 is real time."),
        Gauge("aureole_auras", "Auras that peers hold of this region's bodies."),
        Gauge("aureole_bodies_away", "Bodies owned here whose centre is outside the region's rectangle."),
        Gauge("aureole_largest_cluster_bodies", "Most bodies in one transfer since the start."),
        Gauge("aureole_waiting_for_regions", "Regions whose frame this one waits for since more than 100 ms."),
        Frames("aureole_frame_cpu_seconds", "CPU time of the whole process per tick, seconds."),
        Frames("aureole_frame_wall_seconds", "Wall time per tick without waits, seconds."),
        Counter("aureole_waits_total", "Times that a phase was ready only later than its time."),
        Counter("aureole_wait_seconds_total", "Wall time spent waiting for peers, seconds."),
        Counter("aureole_violations_total", "Pairs of bodies that touched while they were stepped apart."),
        Counter("aureole_transfers_total", transfers, {{"cause", "aura_collision"}}),
        Counter("aureole_transfers_total", transfers, {{"cause", "boundary_traverse"}}),
        Counter("aureole_bodies_moved_total", "Bodies in these transfers."),
        Counter("aureole_aura_updates_total", "Aura updates sent, all links."),
        Counter("aureole_link_sent_bytes_total", "Payload of the messages sent, all links, bytes."),
        Counter("aureole_link_sent_frames_total", "Frames sent, all links."),
        Counter("aureole_link_reconnects_total", "Connections that replaced a lost one."),
        Counter("aureole_link_refused_frames_total", "Frames that were malformed or not the protocol's."),
        Counter("aureole_link_refused_hellos_total", "Handshakes refused, here or by the peer."),
        Counter("aureole_home_crossings_total", "Times that a body's centre crossed into another region's rectangle."),
    });
  }

  prometheus::Exposer exposer;
  std::shared_ptr<prometheus::Registry> registry;
  std::string endpoint;
  std::mutex mutex;
  prometheus::Labels labels;
  std::unique_ptr<Set> set;  // since the assignment
};

RegionMetrics::RegionMetrics(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
RegionMetrics::~RegionMetrics() = default;

absl::StatusOr<std::unique_ptr<RegionMetrics>> RegionMetrics::Serve(const std::string& address) {
  try {  // the library's only way to say no
    auto impl = std::make_unique<Impl>(address);
    const std::string host = address.substr(0, address.rfind(':'));
    impl->endpoint = absl::StrCat(host, ":", impl->exposer.GetListeningPorts().at(0));
    return std::unique_ptr<RegionMetrics>(new RegionMetrics(std::move(impl)));
  } catch (const std::exception& e) {
    return absl::UnavailableError(absl::StrCat("--metrics: cannot listen on ", address, ": ", e.what()));
  }
}

const std::string& RegionMetrics::endpoint() const { return impl_->endpoint; }

void RegionMetrics::Assigned(const std::string& world, RegionId region) {
  const std::lock_guard lock(impl_->mutex);
  impl_->labels = {{"world", world}, {"region", std::to_string(region)}};
  impl_->set = impl_->MakeSet();
}

void RegionMetrics::AddTick(const FrameSample& sample) {
  const std::lock_guard lock(impl_->mutex);
  if (impl_->set == nullptr) return;
  impl_->set->frame.Observe(sample.process_cpu * 1e-3);
  impl_->set->frame_wall.Observe(sample.wall * 1e-3);
}

void RegionMetrics::Update(const v1::Report& r) {
  const std::lock_guard lock(impl_->mutex);
  if (impl_->set == nullptr) return;
  Impl::Set& s = *impl_->set;
  const auto d = [](int64_t n) { return static_cast<double>(n); };
  s.tick.Set(d(r.tick()));
  s.bodies.Set(d(r.bodies()));
  s.awake.Set(d(r.awake()));
  s.real_time_factor.Set(r.real_time_factor());
  s.auras.Set(d(r.auras_told()));
  s.away.Set(d(r.away_bodies()));
  s.largest_cluster.Set(d(r.largest_cluster()));
  s.waiting_for.Set(d(r.waiting_for_size()));
  Impl::Raise(&s.waits, d(r.waits()));
  Impl::Raise(&s.wait_seconds, d(r.wait_us()) * 1e-6);
  Impl::Raise(&s.violations, d(r.violations()));
  Impl::Raise(&s.collisions, d(r.transfers() - r.returns()));
  Impl::Raise(&s.returns, d(r.returns()));
  Impl::Raise(&s.bodies_moved, d(r.bodies_moved()));
  Impl::Raise(&s.aura_updates, d(r.aura_updates()));
  Impl::Raise(&s.bytes, d(r.bytes_sent()));
  Impl::Raise(&s.frames, d(r.frames_sent()));
  Impl::Raise(&s.reconnects, d(r.reconnects()));
  Impl::Raise(&s.refused_frames, d(r.refused_frames()));
  Impl::Raise(&s.home_crossings, d(r.home_crossings()));
}

void RegionMetrics::UpdateRefusedLinks(int64_t total) {
  const std::lock_guard lock(impl_->mutex);
  if (impl_->set != nullptr) Impl::Raise(&impl_->set->refused_links, static_cast<double>(total));
}

}  // namespace aureole
