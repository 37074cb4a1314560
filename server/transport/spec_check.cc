#include "server/transport/spec_check.h"

#include <algorithm>
#include <cmath>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_format.h>

namespace aureole {
namespace {

std::string Show(double value, const char* unit) {
  return absl::StrCat(absl::StrFormat("%.9g", value), *unit ? " " : "", unit);
}

// sin(x) and cos(x) for |x| <= pi/4 by their series, in one order of operations: libm may differ between machines, and
// every region must read the same world (EXACT.md L9).
double Series(double x, bool cosine) {
  double term = cosine ? 1 : x, sum = term;
  for (int i = cosine ? 1 : 2; i < 24; i += 2) {
    term *= -x * x / (i * (i + 1));
    sum += term;
  }
  return sum;
}

struct SinCos {
  double sin, cos;
};

// Exact at multiples of 90 degrees.
SinCos SinCosOfDegrees(double degrees) {
  const double quarter = std::nearbyint(degrees / 90);
  const double rest = (degrees - quarter * 90) * (3.14159265358979323846 / 180);
  const double s = Series(rest, false), c = Series(rest, true);
  switch (static_cast<int>(quarter) & 3) {
    case 0:
      return {s, c};
    case 1:
      return {c, -s};
    case 2:
      return {-s, -c};
    default:
      return {-c, s};
  }
}

bool Finite(const Vec3& v) { return std::isfinite(v.x()) && std::isfinite(v.y()) && std::isfinite(v.z()); }

}  // namespace

Path Path::operator/(std::string_view field) const {
  return Path(text_.empty() ? std::string(field)
                            : absl::StrCat(text_, ".", absl::string_view(field.data(), field.size())));
}
Path Path::operator[](int index) const { return Path(absl::StrCat(text_, "[", index, "]")); }
Path Path::operator[](std::string_view key) const {
  return Path(absl::StrCat(text_, "[\"", absl::string_view(key.data(), key.size()), "\"]"));
}

void SpecCheck::Fail(const Path& path, std::string_view what, v1::Reason reason) {
  if (!status_.ok()) return;
  reason_ = reason;
  field_ = path.str();
  what_ = std::string(what);
  status_ = absl::InvalidArgumentError(absl::StrCat(field_, ": ", what_));
}

double SpecCheck::In(const limits::Range& range, const Path& path, double value) {
  if (value >= range.min && value <= range.max) return value;
  if (std::isnan(value)) {
    Fail(path, "must be a number (is NaN)");
  } else if (value < range.min) {
    Fail(path, absl::StrCat("must be at least ", Show(range.min, range.unit), " (is ", Show(value, ""), ")"));
  } else {
    Fail(path, absl::StrCat("must be at most ", Show(range.max, range.unit), " (is ", Show(value, ""), ")"));
  }
  return range.min;
}

double SpecCheck::Positive(const limits::Range& range, const Path& path, double value) {
  if (value == 0) Fail(path, "must be > 0; leave it out for the default");
  return In(range, path, value);
}

int64_t SpecCheck::Whole(const Path& path, int64_t value, int64_t min, int64_t max) {
  if (value >= min && value <= max) return value;
  Fail(path, absl::StrCat("must be from ", min, " to ", max, " (is ", value, ")"));
  return min;
}

Vec3 SpecCheck::Vector(const limits::Range& range, const Path& path, const v1::Vec3& v) {
  const limits::Range both{-range.max, range.max, range.unit};
  Vec3 out = Vec3::Zero();
  const double from[3] = {v.x(), v.y(), v.z()};
  static constexpr const char* kAxis[3] = {"x", "y", "z"};
  for (int i = 0; i < 3; ++i) {
    // The path is made for a mistake only: a mesh has a million of these.
    if (from[i] >= both.min && from[i] <= both.max) {
      out[i] = from[i];
    } else {
      In(both, path / kAxis[i], from[i]);
    }
  }
  return out;
}

Vec3 SpecCheck::Direction(const Path& path, const v1::Vec3& v) {
  const Vec3 d(v.x(), v.y(), v.z());
  const double length = std::sqrt(d.x() * d.x() + d.y() * d.y() + d.z() * d.z());
  if (!Finite(d) || !(length > 1e-9) || !(length < 1e9)) {
    Fail(path, "must be a direction: three finite numbers, not all 0");
    return Vec3::UnitY();
  }
  return d / length;
}

Quat SpecCheck::QuatFrom(const Path& path, const v1::Quaternion& q) {
  const double length = std::sqrt(q.x() * q.x() + q.y() * q.y() + q.z() * q.z() + q.w() * q.w());
  if (!(length > 1e-9) || !(length < 1e9)) {
    Fail(path, "must be a quaternion: four finite numbers, not all 0; leave it out for no turn");
    return Quat::Identity();
  }
  return {q.w() / length, q.x() / length, q.y() / length, q.z() / length};
}

Quat SpecCheck::TurnToQuat(const Path& path, const v1::Turn& turn) {
  const Vec3 axis = Direction(path / "axis", turn.axis());
  const SinCos half = SinCosOfDegrees(In(limits::kDegrees, path / "degrees", turn.degrees()) / 2);
  return {half.cos, axis.x() * half.sin, axis.y() * half.sin, axis.z() * half.sin};
}

int64_t SpecCheck::Microseconds(const Path& path, const google::protobuf::Duration& d, int64_t min, int64_t max) {
  if (d.nanos() % 1000 != 0) Fail(path, "must be a whole number of microseconds");
  constexpr int64_t kMostSeconds = 1'000'000'000'000;
  // A message that was not JSON can hold any number of seconds.
  const int64_t seconds = std::clamp(d.seconds(), -kMostSeconds, kMostSeconds);
  const int64_t us = seconds * 1'000'000 + d.nanos() / 1000;
  if (us >= min && us <= max) return us;
  Fail(path, absl::StrCat("must be from ", Show(static_cast<double>(min) * 1e-6, "s"), " to ",
                          Show(static_cast<double>(max) * 1e-6, "s"), " (is ",
                          Show(static_cast<double>(us) * 1e-6, "s"), ")"));
  return min;
}

}  // namespace aureole
