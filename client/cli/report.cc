#include "client/cli/report.h"

#include <algorithm>
#include <filesystem>
#include <iostream>
#include <limits>
#include <map>
#include <unordered_map>
#include <vector>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/exit_codes.h"
#include "client/cli/mcap_reader.h"
#include "client/cli/output_directory.h"
#include "client/cli/recording.h"
#include "client/cli/svg_plot.h"
#include "client/src/layout_follower.h"
#include "client/src/replica_decoder.h"

namespace aureole {
namespace {

using Json = nlohmann::ordered_json;

// Of the bodies of all regions after one tick, J. Of turning bodies only the motion of their centres counts: inertia is
// not recorded.
struct Energy {
  double motion = 0, height = 0;
  int regions = 0;  // that have told theirs
};

struct Totals {
  int64_t transfers = 0, bodies = 0, violations = 0;
  double longest_ms = 0, least_factor = std::numeric_limits<double>::infinity();
};

class Report {
 public:
  absl::Status Take(const McapMessage& message) {
    const auto is = [&message](const google::protobuf::Descriptor* type) { return message.type == type->full_name(); };
    const auto parse = [&message](google::protobuf::Message* to) {
      return to->ParseFromArray(message.data.data(), static_cast<int>(message.data.size()));
    };
    bool fine = true;
    if (is(v1::GetWorldResponse::descriptor())) {
      fine = parse(&world_);
    } else if (is(v1::Snapshot::descriptor())) {
      v1::Snapshot snapshot;
      fine = parse(&snapshot);
      if (snapshot.world().has_gravity()) gravity_ = snapshot.world().gravity();
    } else if (is(v1::RegionStatus::descriptor())) {
      v1::RegionStatus status;
      fine = parse(&status);
      if (fine) Add(status);
    } else if (is(v1::ReplicaFrame::descriptor())) {
      v1::ReplicaFrame frame;
      fine = parse(&frame);
      if (fine) return Add(frame);
    } else if (is(v1::Input::descriptor())) {
      ++inputs_;
    }
    return fine ? absl::OkStatus() : absl::InvalidArgumentError("a message that cannot be read");
  }

  bool empty() const { return frame_ms_.empty() && energies_.empty(); }

  std::vector<Chart> Charts() const {
    std::vector<Chart> out;
    const double step = std::max(1.0, std::ceil(seconds_ / 12));
    out.push_back({"Frame time, the longest since the last status", "simulated time, s", "CPU ms per tick", step, {}});
    for (const auto& [region, points] : frame_ms_) out.back().series.push_back({RegionName(region), points});
    out.push_back({"Dilation", "simulated time, s", "simulated per wall time", step, {}});
    for (const auto& [region, points] : factor_) out.back().series.push_back({RegionName(region), points});
    out.push_back({"Transfers", "simulated time, s", "since the start, all regions", step, {}});
    out.back().series.push_back({"transfers", SumOver(transfers_)});
    out.push_back({"Energy: motion of the centres; height above the least", "simulated time, s", "kJ", step, {}});
    Series motion{"motion", {}}, height{"height", {}}, both{"sum", {}};
    double least = std::numeric_limits<double>::infinity();
    for (const auto& [tick, e] : energies_) {
      if (Whole(e)) least = std::min(least, e.height);
    }
    for (const auto& [tick, e] : energies_) {
      if (!Whole(e)) continue;
      const double t = Seconds(tick);
      motion.points.emplace_back(t, e.motion * 1e-3);
      height.points.emplace_back(t, (e.height - least) * 1e-3);
      both.points.emplace_back(t, (e.motion + e.height - least) * 1e-3);
    }
    out.back().series = {motion, height, both};
    return out;
  }

  Json Summary() const {
    Json regions = Json::array();
    Totals all;
    for (const auto& [region, t] : totals_) {
      regions.push_back({{"region", region},
                         {"bodies", t.bodies},
                         {"longest_frame_ms", t.longest_ms},
                         {"least_real_time_factor", t.least_factor},
                         {"transfers", t.transfers},
                         {"violations", t.violations}});
      all.bodies += t.bodies;
      all.transfers += t.transfers;
      all.violations += t.violations;
      all.longest_ms = std::max(all.longest_ms, t.longest_ms);
      all.least_factor = std::min(all.least_factor, t.least_factor);
    }
    return {{"world", world_.name()},
            {"seconds", seconds_},
            {"inputs", inputs_},
            {"bodies", all.bodies},
            {"transfers", all.transfers},
            {"violations", all.violations},
            {"longest_frame_ms", all.longest_ms},
            {"least_real_time_factor", all.least_factor},
            {"regions", regions}};
  }
  const std::string& name() const { return world_.name(); }

 private:
  using Points = std::vector<std::pair<double, double>>;

  static std::string RegionName(int region) { return absl::StrCat("region ", region); }

  double Seconds(int64_t tick) const { return static_cast<double>((tick - first_) * world_.tick_us()) * 1e-6; }
  bool Whole(const Energy& e) const { return e.regions == static_cast<int>(client::EndpointsOf(world_).size()); }

  // From here on time is told from the first tick of what is charted.
  double Reach(int64_t tick) {
    if (first_ < 0) first_ = tick;
    const double t = std::max(0.0, Seconds(tick));
    seconds_ = std::max(seconds_, t);
    return t;
  }

  void Add(const v1::RegionStatus& s) {
    const double t = Reach(s.tick());
    frame_ms_[s.region()].emplace_back(t, s.frame_max_ms());
    factor_[s.region()].emplace_back(t, s.real_time_factor());
    transfers_[s.region()].emplace_back(t, static_cast<double>(s.transfers()));
    Totals& total = totals_[s.region()];
    total.bodies = s.bodies();
    total.transfers = s.transfers();
    total.violations = s.violations();
    total.longest_ms = std::max(total.longest_ms, s.frame_max_ms());
    total.least_factor = std::min(total.least_factor, s.real_time_factor());
  }

  absl::Status Add(const v1::ReplicaFrame& frame) {
    for (const v1::BodyDescription& d : frame.described()) {
      uint64_t body = 0;
      for (uint64_t step : d.body()) mass_[body += step] = d.mass();
    }
    auto [it, fresh] = decoders_.try_emplace(frame.region(), v1::FINE, true);
    std::string error;
    if (!it->second.Apply(frame, &error)) return absl::InvalidArgumentError("a frame: " + error);
    complete_[frame.region()] |= !frame.more();
    if (!complete_[frame.region()]) return absl::OkStatus();
    Reach(frame.tick());
    Energy& e = energies_[frame.tick()];
    ++e.regions;
    it->second.ForEach([&](uint64_t body) {
      const client::ToldBody b = it->second.Get(body);
      const double mass = mass_[body];
      const auto& v = b.velocity;
      const auto& p = b.position;
      e.motion += mass * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) / 2;
      e.height -= mass * (gravity_.x() * p[0] + gravity_.y() * p[1] + gravity_.z() * p[2]);
    });
    return absl::OkStatus();
  }

  // Of step functions of time: their sum whenever one changes.
  static Points SumOver(const std::map<int, Points>& series) {
    std::multimap<double, std::pair<int, double>> events;
    for (const auto& [region, points] : series) {
      for (const auto& [t, value] : points) events.emplace(t, std::pair(region, value));
    }
    std::map<int, double> now;
    Points out;
    for (const auto& [t, event] : events) {
      now[event.first] = event.second;
      if (now.size() < series.size()) continue;
      double sum = 0;
      for (const auto& [region, value] : now) sum += value;
      out.emplace_back(t, sum);
    }
    return out;
  }

  v1::GetWorldResponse world_;
  v1::Vec3 gravity_ = [] {
    v1::Vec3 g;
    g.set_y(-9.81);
    return g;
  }();
  int64_t first_ = -1, inputs_ = 0;
  double seconds_ = 0;
  std::map<int, Points> frame_ms_, factor_, transfers_;
  std::map<int, Totals> totals_;
  std::map<int64_t, Energy> energies_;
  std::map<int, client::ReplicaDecoder> decoders_;
  std::map<int, bool> complete_;
  std::unordered_map<uint64_t, double> mass_;
};

}  // namespace

CLI::App* AddReport(CLI::App& app, ReportOptions* o) {
  CLI::App* c = app.add_subcommand("report", "Charts of a recording: frame times, dilation, transfers, energy");
  c->add_option("file", o->file, "What aureole record has written")->required()->type_name("FILE");
  c->add_option("--out,-o", o->out, "The charts (SVG); FILE.svg when not given")->type_name("FILE");
  c->add_flag("--json", o->json, "The summary as JSON");
  c->footer(std::string("Examples:\n"
                        "  aureole report run.mcap\n"
                        "  aureole report run.mcap --out run.svg --json\n\n") +
            kExitCodesHelp);
  return c;
}

int RunReport(const ReportOptions& o) {
  Report report;
  bool whole = false;
  const absl::Status read = ReadMcap(
      o.file, [&](const McapMessage& message) { return report.Take(message); }, &whole);
  if (!read.ok()) {
    std::cerr << "aureole: " << std::string(read.message()) << '\n';
    return kExitBadInput;
  }
  if (report.empty()) {
    std::cerr << "aureole: " << o.file << ": has neither frames nor the status of a region\n";
    return kExitBadInput;
  }
  if (!whole) std::cerr << "aureole: " << o.file << " was cut off; what is there is charted\n";
  const std::string out = !o.out.empty() ? o.out : std::filesystem::path(o.file).replace_extension(".svg").string();
  constexpr int kPerRow = 2;
  const absl::Status written = WriteText(out, RenderSvg("World " + report.name(), report.Charts(), kPerRow));
  if (!written.ok()) {
    std::cerr << "aureole: " << std::string(written.message()) << '\n';
    return kExitFailed;
  }
  const Json s = report.Summary();
  if (o.json) {
    std::cout << s.dump() << '\n';
  } else {
    std::cout << absl::StrFormat(
        "%s: %.1f s, %d bodies, %d inputs, %d transfers, %d violations, longest frame %.2f ms, least speed %.2f\n", out,
        s["seconds"].get<double>(), s["bodies"].get<int64_t>(), s["inputs"].get<int64_t>(),
        s["transfers"].get<int64_t>(), s["violations"].get<int64_t>(), s["longest_frame_ms"].get<double>(),
        s["least_real_time_factor"].get<double>());
  }
  return kExitOk;
}

}  // namespace aureole
