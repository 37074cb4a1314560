#include "client/cli/replay.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <iostream>

#include <absl/strings/str_format.h>
#include <nlohmann/json.hpp>

#include "client/cli/exit_codes.h"
#include "client/cli/recording.h"
#include "server/control/interrupts.h"
#include "server/replay/replay.h"

namespace aureole {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;

int Refuse(const absl::Status& status) {
  std::cerr << "aureole: " << std::string(status.message()) << '\n';
  return kExitBadInput;
}

std::string HashText(uint64_t hash) { return hash == 0 ? "is not there" : absl::StrFormat("%016x", hash); }

}  // namespace

CLI::App* AddReplay(CLI::App& app, ReplayOptions* o) {
  CLI::App* c = app.add_subcommand("replay", "Simulate a recording again, in one piece");
  c->add_option("file", o->file, "What aureole record has written")->required()->type_name("FILE");
  c->add_flag("--verify", o->verify,
              "Compare the state of every body with that on the servers, bit for bit; names the first tick and body "
              "that differ");
  c->add_flag("--json", o->json, "JSON");
  c->footer(std::string("Examples:\n"
                        "  aureole replay run.mcap --verify\n\n"
                        "Needs the binary of the servers: another build may compute other bits.\n") +
            kExitCodesHelp);
  return c;
}

int RunReplay(const ReplayOptions& o) {
  absl::StatusOr<RecordedRun> recorded = ReadRecording(o.file);
  if (!recorded.ok()) return Refuse(recorded.status());
  absl::StatusOr<std::unique_ptr<Replay>> begun = Replay::Begin(recorded->snapshots);
  if (!begun.ok()) return Refuse(begun.status());
  Replay& replay = **begun;
  if (!recorded->whole) std::cerr << "aureole: " << o.file << " was cut off; what is there is replayed\n";
  // The servers tell none that the snapshots have.
  for (const v1::Input& input : recorded->inputs) {
    if (absl::Status s = replay.Add(input); !s.ok()) return Refuse(s);
  }
  const int64_t first = replay.tick(), last = recorded->hashes.empty() ? first : recorded->hashes.rbegin()->first;
  const bool terminal = isatty(STDERR_FILENO) != 0;
  const Clock::time_point begin = Clock::now();
  Clock::time_point told = begin;
  int64_t compared = 0, states = 0;
  std::optional<Replay::Difference> difference;
  for (const auto& [tick, hashes] : recorded->hashes) {
    if (tick < first) continue;
    replay.RunTo(tick);
    if (o.verify) {
      difference = replay.Compare(hashes);
      ++compared;
      states += static_cast<int64_t>(hashes.size());
    }
    if (difference.has_value()) break;
    if (Interrupts() > 0) return kExitInterrupted;
    if (terminal && Clock::now() - told > std::chrono::milliseconds(200)) {
      told = Clock::now();
      std::cerr << absl::StrFormat("\r\033[Kreplayed %d of %d ticks", tick - first, last - first) << std::flush;
    }
  }
  if (terminal) std::cerr << "\r\033[K";
  const double simulated = static_cast<double>(replay.tick() - first) * replay.tick_seconds();
  const double wall = std::chrono::duration<double>(Clock::now() - begin).count();
  if (o.json) {
    Json out{{"from_tick", first},        {"to_tick", replay.tick()},
             {"bodies", replay.bodies()}, {"inputs", recorded->inputs.size()},
             {"seconds", simulated},      {"wall_seconds", wall}};
    if (o.verify) {
      out["compared_ticks"] = compared;
      out["compared_states"] = states;
      out["equal"] = !difference.has_value();
      if (difference.has_value()) {
        out["first_difference"] = {{"tick", replay.tick()}, {"body", difference->body}};
      }
    }
    std::cout << out.dump() << '\n';
  } else {
    std::cout << absl::StrFormat("%d bodies, %.1f s from tick %d to %d with %d inputs, simulated in %.1f s\n",
                                 replay.bodies(), simulated, first, replay.tick(), recorded->inputs.size(), wall);
    if (difference.has_value()) {
      std::cout << absl::StrFormat("DIFFERS, first at tick %d, body %d: recorded %s, simulated %s\n", replay.tick(),
                                   difference->body, HashText(difference->recorded), HashText(difference->simulated));
    } else if (o.verify) {
      std::cout << absl::StrFormat("equal, bit for bit: %d states of bodies at %d ticks\n", states, compared);
    }
  }
  if (difference.has_value()) return kExitFailed;
  if (o.verify && compared == 0) {
    std::cerr << "aureole: there is nothing to compare: no tick of which all regions told their hashes\n";
    return kExitFailed;
  }
  return kExitOk;
}

}  // namespace aureole
