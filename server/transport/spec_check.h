// Turns the numbers of a WorldSpec into the core's values and refuses those that are not sane, with the path of the
// field, what is wanted, what is there, and the remedy.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include <absl/status/status.h>

#include "aureole/v1/error.pb.h"
#include "aureole/v1/types.pb.h"
#include "aureole/v1/world.pb.h"
#include "google/protobuf/duration.pb.h"
#include "server/core/limits.h"
#include "server/core/types.h"

namespace aureole {

// The place of a field, as a message names it: bodies[3].shape.sphere.radius or shapes["ball"].sphere.
class Path {
 public:
  Path() = default;
  Path operator/(std::string_view field) const;
  Path operator[](int index) const;
  Path operator[](std::string_view key) const;
  const std::string& str() const { return text_; }

 private:
  explicit Path(std::string text) : text_(std::move(text)) {}
  std::string text_;
};

// Keeps the first mistake. After a mistake every function still returns some sane value, so that a reader can go on to
// its end and look at status() once.
class SpecCheck {
 public:
  bool ok() const { return status_.ok(); }
  // OK, or InvalidArgument "<path>: <what>".
  const absl::Status& status() const { return status_; }
  // Of the mistake.
  v1::Reason reason() const { return reason_; }
  const std::string& field() const { return field_; }
  const std::string& what() const { return what_; }

  void Fail(const Path& path, std::string_view what, v1::Reason reason = v1::BAD_VALUE);

  // The value, if it is a number within the closed range.
  double In(const limits::Range& range, const Path& path, double value);
  // For a weight or a rate: also refuses 0.
  double Positive(const limits::Range& range, const Path& path, double value);
  // The value, if it is from min to max.
  int64_t Whole(const Path& path, int64_t value, int64_t min, int64_t max);

  // Each component within the range, mirrored to negative values. An unset message is the zero vector.
  Vec3 Vector(const limits::Range& range, const Path& path, const v1::Vec3& v);
  Vec3 Position(const Path& path, const v1::Vec3& v) { return Vector(limits::kCoordinate, path, v); }
  // Length 1; refuses the zero vector.
  Vec3 Direction(const Path& path, const v1::Vec3& v);

  // `spec` has the fields `orientation` and `turn`, at most one of them set; neither: the identity.
  template <class Spec>
  Quat Orientation(const Path& path, const Spec& spec) {
    if (spec.has_orientation() && spec.has_turn()) Fail(path / "turn", "is given beside orientation; give only one");
    if (spec.has_turn()) return TurnToQuat(path / "turn", spec.turn());
    return spec.has_orientation() ? QuatFrom(path / "orientation", spec.orientation()) : Quat::Identity();
  }

  // In microseconds, within the closed range.
  int64_t Microseconds(const Path& path, const google::protobuf::Duration& d, int64_t min, int64_t max);

 private:
  Quat QuatFrom(const Path& path, const v1::Quaternion& q);
  Quat TurnToQuat(const Path& path, const v1::Turn& turn);

  absl::Status status_;
  v1::Reason reason_ = v1::REASON_UNSPECIFIED;
  std::string field_, what_;
};

}  // namespace aureole
