#include "server/core/injector.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace aureole {
namespace {

__extension__ using Int128 = __int128;

// Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014: the finaliser of SplitMix64.
uint64_t Mix(uint64_t z) {
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return z ^ (z >> 31);
}
constexpr uint64_t kGolden = 0x9e3779b97f4a7c15u;

// The random numbers of one body: SplitMix64 from a state that is a hash of who it is. Nothing is kept between bodies.
class Draws {
 public:
  Draws(uint64_t seed, int injector, uint64_t number)
      : state_(Mix(Mix(Mix(seed + kGolden) + static_cast<uint64_t>(injector) + kGolden) + number + kGolden)) {}

  // Uniform in [0, 1), on the grid of 2^-53.
  double Unit() { return static_cast<double>(Mix(state_ += kGolden) >> 11) * 0x1p-53; }
  double Between(double min, double max) { return min + Unit() * (max - min); }
  // One statement per draw: the order in which arguments are evaluated is not defined.
  Vec3 Between(const Vec3& min, const Vec3& max) {
    const double x = Between(min.x(), max.x());
    const double y = Between(min.y(), max.y());
    const double z = Between(min.z(), max.z());
    return {x, y, z};
  }
  // Index into `items` with probability weight / sum of weights.
  template <class T>
  size_t Choose(const std::vector<T>& items) {
    double sum = 0;
    for (const T& item : items) sum += item.weight;
    double left = Unit() * sum;
    for (size_t i = 0; i + 1 < items.size(); ++i) {
      left -= items[i].weight;
      if (left < 0) return i;
    }
    return items.size() - 1;
  }
  // Uniform in the orientations. Marsaglia, "Choosing a point from the surface of a sphere", 1972, for the 3-sphere:
  // it needs a square root only, which every machine rounds alike.
  Quat Orientation() {
    double a = 0, b = 0, c = 0, d = 0, first = 0, second = 0;
    do {
      a = Between(-1, 1);
      b = Between(-1, 1);
      first = a * a + b * b;
    } while (first >= 1);
    do {
      c = Between(-1, 1);
      d = Between(-1, 1);
      second = c * c + d * d;
    } while (second >= 1 || second == 0);
    const double scale = std::sqrt((1 - first) / second);
    return {d * scale, a, b, c * scale};  // w, x, y, z
  }

 private:
  uint64_t state_;
};

BodySpec MakeBody(const Injector& injector, uint64_t seed, int index, uint64_t number) {
  Draws draws(seed, index, number);
  const Injector::Volume& volume = injector.volumes[draws.Choose(injector.volumes)];
  const InjectorShape& kind = injector.shapes[draws.Choose(injector.shapes)];
  BodySpec body;
  body.id = InjectedId(index, number);
  body.shape = kind.shape;
  body.mass = kind.mass;
  body.material = kind.material;
  body.ccd = kind.ccd;
  body.position = draws.Between(volume.min, volume.max);
  body.velocity = draws.Between(injector.min_velocity, injector.max_velocity);
  body.angular_velocity = draws.Between(Vec3::Constant(-injector.max_spin), Vec3::Constant(injector.max_spin));
  if (injector.random_orientation) body.orientation = draws.Orientation();
  return body;
}

}  // namespace

BodyId InjectedId(int injector, uint64_t number) {
  return uint64_t{1} << 62 | static_cast<uint64_t>(injector) << 48 | number;
}

// Body q (0, 1, ...) is made at the first tick n >= 1 with n * tick >= start + q / rate, if q / rate < duration. In
// microseconds and bodies per 1000 s, q <= elapsed * rate / 10^9, all in integers.
uint64_t InjectedBy(const Injector& injector, int64_t tick_us, Tick n) {
  if (n < 1) return 0;
  const Int128 rate = std::llround(injector.rate * 1e3);
  const Int128 elapsed = Int128{n} * tick_us - std::llround(injector.start * 1e6);
  const Int128 duration = std::llround(injector.duration * 1e6);
  if (elapsed < 0 || duration <= 0 || rate <= 0) return 0;
  constexpr Int128 kOne = 1'000'000'000;
  const Int128 due = elapsed * rate / kOne + 1;
  const Int128 total = (duration * rate + kOne - 1) / kOne;
  return static_cast<uint64_t>(std::min(due, total));
}

void InjectorInputs(const std::vector<Injector>& injectors, uint64_t seed, int64_t tick_us, Tick n,
                    std::vector<Input>* out) {
  for (size_t i = 0; i < injectors.size(); ++i) {
    const int index = static_cast<int>(i);
    const uint64_t end = InjectedBy(injectors[i], tick_us, n);
    for (uint64_t number = InjectedBy(injectors[i], tick_us, n - 1); number < end; ++number) {
      auto body = std::make_shared<const BodySpec>(MakeBody(injectors[i], seed, index, number));
      Input input;
      input.tick = n;
      // Ids grow with the injector and the number, and are greater than the sequence of any fixed input.
      input.sequence = body->id;
      input.kind = Input::Kind::kSpawn;
      input.body = body->id;
      input.spawn = std::move(body);
      out->push_back(std::move(input));
    }
  }
}

}  // namespace aureole
