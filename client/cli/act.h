// `aureole push`, `aureole spawn`, `aureole remove`, `aureole ray`: what a client does to a running world.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

namespace aureole {

struct PushOptions {
  std::string server;
  uint64_t body = 0;
  std::vector<double> sphere;  // x, y, z, radius
  double outward = 0;
  bool fades = false;
  std::vector<double> impulse, velocity, force, spin, point;
  double seconds = 0;
  int times = 1;
  bool json = false;
};
CLI::App* AddPush(CLI::App& app, PushOptions* options);
int RunPush(const PushOptions& options);

struct SpawnOptions {
  std::string server, shape;
  double mass = 1;
  std::vector<double> position, velocity;
  bool json = false;
};
CLI::App* AddSpawn(CLI::App& app, SpawnOptions* options);
int RunSpawn(const SpawnOptions& options);

struct RayOptions {
  std::string server;
  std::vector<double> from, direction;
  double length = 1000;
  bool json = false;
};
CLI::App* AddRay(CLI::App& app, RayOptions* options);
int RunRay(const RayOptions& options);

struct RemoveOptions {
  std::string server;
  std::vector<uint64_t> bodies;
  bool json = false;
};
CLI::App* AddRemove(CLI::App& app, RemoveOptions* options);
int RunRemove(const RemoveOptions& options);

}  // namespace aureole
