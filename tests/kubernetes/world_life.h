// One World in a fake cluster, with real control planes and region servers.
#pragma once

#include <gtest/gtest.h>

#include <chrono>
#include <fstream>
#include <functional>
#include <iterator>
#include <string>
#include <thread>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

#include "server/control/kubernetes/json.h"
#include "server/control/local_allocator.h"
#include "server/control/run.h"
#include "server/control/world_file.h"
#include "tests/kubernetes/fake_cluster.h"

namespace aureole::kubernetes {

inline constexpr char kWorlds[] = "/apis/aureole.dev/v1alpha1/namespaces/test/worlds/";
inline constexpr char kPods[] = "/api/v1/namespaces/test/pods/";
inline constexpr char kFile[] = AUREOLE_WORLDS "/border-pile.json";
inline constexpr int kSeconds = 6;  // of simulated time, in most tests

inline bool Await(const std::function<bool()>& condition, std::chrono::seconds at_most = std::chrono::seconds(60)) {
  const auto end = std::chrono::steady_clock::now() + at_most;
  while (!condition()) {
    if (std::chrono::steady_clock::now() > end) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
  return true;
}

inline std::string FileText() {
  std::ifstream in(kFile);
  return std::string(std::istreambuf_iterator<char>(in), {});
}

// The hash of the last state of an undisturbed run.
inline std::string HashOfTheEnd(int length_s) {
  const absl::StatusOr<WorldFile> file = OpenWorldFile(kFile);
  EXPECT_TRUE(file.ok()) << file.status();
  RunOptions options;
  options.world = file->spec;
  options.regions = file->world.layout.size();
  options.no_real_time = true;
  options.last_tick = TicksIn(length_s, file->world.environment.tick_us);
  options.hash_every = 100;
  LocalAllocator allocator({.executable = AUREOLE_REGION, .log_directory = {}});
  RunResult result;
  const absl::Status s = RunWorld(
      options, allocator, [](const RunStatus&) { return true; }, &result);
  EXPECT_TRUE(s.ok()) << s;
  return absl::StrFormat("%016x", result.hashes.back().hash);
}

class WorldLife : public testing::Test {
 protected:
  ~WorldLife() override {
    if (HasFailure()) std::cerr << cluster_.World("w").dump(1) << "\n" << cluster_.Logs();
  }
  Json Spec() const {
    return {{"world", Json::parse(FileText())},
            {"storage", {{"hostPath", cluster_.disk()}}},
            {"duration", absl::StrCat(seconds_, "s")},
            {"checkpointSeconds", 0.5},
            {"hashEvery", 100}};
  }
  void Create(const Json& spec) { cluster_.api().Put(absl::StrCat(kWorlds, "w"), {{"kind", "World"}, {"spec", spec}}); }
  Json Status() { return cluster_.World("w").value("status", Json::object()); }
  std::string Phase() { return TextAt(Status(), {"phase"}); }
  int64_t Tick() { return IntegerAt(Status(), {"tick"}).value_or(0); }
  bool AwaitTick(int64_t tick) {
    return Await([&] { return Phase() == "Running" && Tick() >= tick; });
  }
  uint64_t Incarnation(int region) {
    const Json status = Status();
    const Json* const regions = Find(status, {"regions"});
    return regions == nullptr ? 0 : (*regions)[static_cast<size_t>(region)]["incarnation"].get<uint64_t>();
  }
  std::string Condition(const std::string& type, const char* field) {
    for (const Json& condition : Status().value("conditions", Json::array())) {
      if (TextAt(condition, {"type"}) == type) return TextAt(condition, {field});
    }
    return "";
  }
  bool HasEvent(const std::string& reason) {
    for (const Json& event : cluster_.api().All("/api/v1/namespaces/test/events")) {
      if (TextAt(event, {"reason"}) == reason) return true;
    }
    return false;
  }
  void ExpectEndAsUndisturbed() {
    ASSERT_TRUE(Await([&] { return Phase() == "Finished"; })) << Phase() << " at tick " << Tick();
    EXPECT_EQ(TextAt(Status(), {"hash", "hash"}), HashOfTheEnd(seconds_));
    EXPECT_EQ(Condition("Exact", "status"), "True");
    EXPECT_TRUE(Await([&] { return cluster_.processes() == 0; }));
  }

  int seconds_ = kSeconds;
  FakeCluster cluster_;
};

}  // namespace aureole::kubernetes
