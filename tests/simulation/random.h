// A small counter-based generator: the same numbers on every machine and library.
#pragma once

#include <cstdint>

namespace aureole::sim {

class Random {
 public:
  // The seed is mixed first: the state of neighbouring seeds must not be neighbours, or their streams overlap.
  explicit Random(uint64_t seed) : state_(Mix(seed + 0x632be59bd9b4e019ull)) {}
  uint64_t Next() { return Mix(state_ += 0x9e3779b97f4a7c15ull); }
  double Unit() { return static_cast<double>(Next() >> 11) * 0x1.0p-53; }
  double In(double a, double b) { return a + (b - a) * Unit(); }
  int Below(int n) { return static_cast<int>(Next() % static_cast<uint64_t>(n)); }
  bool Chance(double p) { return Unit() < p; }

 private:
  static uint64_t Mix(uint64_t z) {
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
  }
  uint64_t state_;
};

}  // namespace aureole::sim
