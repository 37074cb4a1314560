#include "server/transport/input_codec.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/core/limits.h"
#include "server/core/live_inputs.h"
#include "server/transport/return_if_error.h"

namespace aureole {
namespace {

using Doubles = google::protobuf::RepeatedField<double>;

absl::Status Bad(const char* field, const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat("input.", field, ": ", what));
}

void Encode(const Vec3& v, Doubles* out) {
  // Also a negative zero has bits to keep.
  const bool zero = v.isZero(0) && !std::signbit(v.x()) && !std::signbit(v.y()) && !std::signbit(v.z());
  if (!zero) out->Add(v.data(), v.data() + 3);
}

absl::Status Decode(const char* field, const Doubles& in, Vec3* out) {
  if (in.empty()) return absl::OkStatus();
  if (in.size() != 3) return Bad(field, absl::StrCat("has ", in.size(), " values, not 3"));
  *out = Vec3(in.Get(0), in.Get(1), in.Get(2));
  return out->allFinite() ? absl::OkStatus() : Bad(field, "is not finite");
}

void Encode(const Quat& q, Doubles* out) { out->Add(q.coeffs().data(), q.coeffs().data() + 4); }

absl::Status Decode(const char* field, const Doubles& in, Quat* out) {
  if (in.size() != 4) return Bad(field, absl::StrCat("has ", in.size(), " values, not 4"));
  *out = Quat(in.Get(3), in.Get(0), in.Get(1), in.Get(2));
  return std::abs(out->norm() - 1) < 1e-6 ? absl::OkStatus() : Bad(field, "is not of length 1");
}

void Encode(const Shape& shape, v1::SolidShape* out) {
  out->set_kind(static_cast<uint32_t>(shape.kind));
  out->set_radius(shape.radius);
  Encode(shape.half, out->mutable_half());
  for (const Vec3& p : shape.points) out->mutable_points()->Add(p.data(), p.data() + 3);
  for (const ChildShape& child : shape.children) {
    v1::SolidShape::Child* c = out->add_children();
    Encode(child.position, c->mutable_position());
    Encode(child.orientation, c->mutable_orientation());
    Encode(*child.shape, c->mutable_shape());
  }
}

bool IsSize(double metres) { return metres >= limits::kSize.min / 2 && metres <= limits::kSize.max; }

absl::Status CheckMeasures(const Shape& s) {
  const bool round = s.kind != ShapeKind::kBox;
  const bool tall = s.kind == ShapeKind::kCapsule || s.kind == ShapeKind::kCylinder;
  if (round && !IsSize(s.radius)) return Bad("spawn.shape.radius", absl::StrCat(s.radius, " m"));
  if (tall && !IsSize(s.half.y())) return Bad("spawn.shape.half", absl::StrCat(s.half.y(), " m"));
  if (!round && !(IsSize(s.half.x()) && IsSize(s.half.y()) && IsSize(s.half.z()))) {
    return Bad("spawn.shape.half", "is no size");
  }
  return absl::OkStatus();
}

absl::Status Decode(const v1::SolidShape& in, bool child, Shape* out) {
  const uint32_t last = static_cast<uint32_t>(child ? ShapeKind::kHull : ShapeKind::kCompound);
  if (in.kind() < static_cast<uint32_t>(ShapeKind::kSphere) || in.kind() > last) {
    return Bad("spawn.shape.kind", absl::StrCat("no shape ", in.kind(), " here"));
  }
  out->kind = static_cast<ShapeKind>(in.kind());
  out->radius = in.radius();
  AUREOLE_RETURN_IF_ERROR(Decode("spawn.shape.half", in.half(), &out->half));
  if (out->kind < ShapeKind::kHull) AUREOLE_RETURN_IF_ERROR(CheckMeasures(*out));
  const bool hull = out->kind == ShapeKind::kHull, compound = out->kind == ShapeKind::kCompound;
  if (in.points_size() % 3 != 0 || in.points_size() > 3 * limits::kMaxHullPoints ||
      (in.points_size() < 3 * 4) == hull) {
    return Bad("spawn.shape.points", absl::StrCat(in.points_size(), " coordinates"));
  }
  for (int i = 0; i < in.points_size(); i += 3) {
    out->points.emplace_back(in.points(i), in.points(i + 1), in.points(i + 2));
    if (!out->points.back().allFinite()) return Bad("spawn.shape.points", "is not finite");
  }
  if ((in.children_size() == 0) == compound || in.children_size() > limits::kMaxChildren) {
    return Bad("spawn.shape.children", absl::StrCat("are ", in.children_size()));
  }
  for (const v1::SolidShape::Child& c : in.children()) {
    ChildShape& to = out->children.emplace_back();
    AUREOLE_RETURN_IF_ERROR(Decode("spawn.shape.children.position", c.position(), &to.position));
    AUREOLE_RETURN_IF_ERROR(Decode("spawn.shape.children.orientation", c.orientation(), &to.orientation));
    auto shape = std::make_shared<Shape>();
    AUREOLE_RETURN_IF_ERROR(Decode(c.shape(), true, shape.get()));
    to.shape = std::move(shape);
  }
  return absl::OkStatus();
}

// `last`: the shape of the spawn before, when it is not to be told again.
void Encode(const BodySpec& body, const Shape* last, v1::NewBody* out) {
  if (body.shape.get() != last) Encode(*body.shape, out->mutable_shape());
  out->set_mass(body.mass);
  Encode(body.position, out->mutable_position());
  Encode(body.orientation, out->mutable_orientation());
  Encode(body.velocity, out->mutable_velocity());
  Encode(body.angular_velocity, out->mutable_angular_velocity());
  const Material& m = body.material;
  for (double value :
       {m.friction, m.rolling_friction, m.spinning_friction, m.restitution, m.linear_damping, m.angular_damping}) {
    out->add_material(value);
  }
  out->set_ccd(body.ccd);
  out->set_asleep(body.asleep);
}

absl::Status Decode(const v1::NewBody& in, const std::shared_ptr<const Shape>& last, BodySpec* out) {
  out->shape = last;
  if (in.has_shape() || last == nullptr) {
    auto shape = std::make_shared<Shape>();
    AUREOLE_RETURN_IF_ERROR(Decode(in.shape(), false, shape.get()));
    out->shape = std::move(shape);
  }
  out->mass = in.mass();
  if (!(out->mass >= limits::kMass.min && out->mass <= limits::kMass.max)) {
    return Bad("spawn.mass", absl::StrCat(out->mass, " kg"));
  }
  AUREOLE_RETURN_IF_ERROR(Decode("spawn.position", in.position(), &out->position));
  AUREOLE_RETURN_IF_ERROR(Decode("spawn.orientation", in.orientation(), &out->orientation));
  AUREOLE_RETURN_IF_ERROR(Decode("spawn.velocity", in.velocity(), &out->velocity));
  AUREOLE_RETURN_IF_ERROR(Decode("spawn.angular_velocity", in.angular_velocity(), &out->angular_velocity));
  if (in.material_size() != 6) return Bad("spawn.material", absl::StrCat("has ", in.material_size(), " values"));
  for (double value : in.material()) {
    if (!(value >= 0) || !std::isfinite(value)) return Bad("spawn.material", "is negative or not finite");
  }
  out->material = {in.material(0), in.material(1), in.material(2), in.material(3), in.material(4), in.material(5)};
  out->ccd = in.ccd();
  out->asleep = in.asleep();
  return absl::OkStatus();
}

void Encode(const LayoutChange& change, v1::LayoutChange* out) {
  out->set_epoch(change.epoch);
  for (const Rect& r : change.regions) {
    for (double edge : {r.min_x, r.max_x, r.min_z, r.max_z}) out->add_region(edge);
  }
  for (int rank : change.ranks) out->add_rank(static_cast<uint32_t>(rank));
  for (RegionId r : change.members) out->add_member(static_cast<uint32_t>(r));
}

// That it is a layout, CheckLiveInput says.
absl::Status Decode(const v1::LayoutChange& in, LayoutChange* out) {
  constexpr int kMost = limits::kMaxRegions;
  if (in.region_size() % 4 != 0 || in.region_size() > 4 * kMost) {
    return Bad("layout.region", absl::StrCat("has ", in.region_size(), " values"));
  }
  if (in.rank_size() > kMost) return Bad("layout.rank", absl::StrCat("has ", in.rank_size(), " values"));
  if (in.member_size() > kMost) return Bad("layout.member", absl::StrCat("has ", in.member_size(), " values"));
  const auto number = [](uint32_t value) { return static_cast<int>(std::min<uint32_t>(value, kMost)); };
  out->epoch = in.epoch();
  for (int i = 0; i < in.region_size(); i += 4) {
    out->regions.push_back({in.region(i), in.region(i + 1), in.region(i + 2), in.region(i + 3)});
  }
  for (uint32_t rank : in.rank()) out->ranks.push_back(number(rank));
  for (uint32_t member : in.member()) out->members.push_back(number(member));
  return absl::OkStatus();
}

bool HasUnknownFields(const google::protobuf::Message& message) {
  const google::protobuf::Reflection* r = message.GetReflection();
  if (!r->GetUnknownFields(message).empty()) return true;
  std::vector<const google::protobuf::FieldDescriptor*> fields;
  r->ListFields(message, &fields);
  for (const auto* field : fields) {
    if (field->cpp_type() != google::protobuf::FieldDescriptor::CPPTYPE_MESSAGE) continue;
    const int n = field->is_repeated() ? r->FieldSize(message, field) : 1;
    for (int i = 0; i < n; ++i) {
      if (HasUnknownFields(field->is_repeated() ? r->GetRepeatedMessage(message, field, i)
                                                : r->GetMessage(message, field))) {
        return true;
      }
    }
  }
  return false;
}

void Encode(const Input& input, const Shape* last, v1::Input* out) {
  out->set_source(input.source);
  out->set_sequence(input.sequence);
  out->set_kind(static_cast<uint32_t>(input.kind));
  if (input.kind == Input::Kind::kSpawn) return Encode(*input.spawn, last, out->mutable_spawn());
  if (input.kind == Input::Kind::kLayout) return Encode(*input.layout, out->mutable_layout());
  out->set_body(input.body);
  Encode(input.linear, out->mutable_linear());
  Encode(input.angular, out->mutable_angular());
  out->set_frame(static_cast<uint32_t>(input.frame));
  Encode(input.point, out->mutable_point());
  if (input.ticks != 1) out->set_ticks(static_cast<uint64_t>(input.ticks));
  if (!input.over_area()) return;
  Encode(input.area.centre, out->mutable_area()->mutable_centre());
  out->mutable_area()->set_radius(input.area.radius);
  out->mutable_area()->set_outward(input.area.outward);
  out->mutable_area()->set_fades(input.area.fades);
}

absl::Status Decode(const v1::Input& in, const std::shared_ptr<const Shape>& last, Input* out) {
  if (HasUnknownFields(in)) return absl::InvalidArgumentError("input: has fields that this version does not know");
  if (in.kind() > static_cast<uint32_t>(Input::Kind::kLayout)) return Bad("kind", "no such kind");
  out->source = in.source();
  out->sequence = in.sequence();
  out->kind = static_cast<Input::Kind>(in.kind());
  if (out->kind == Input::Kind::kSpawn) {
    auto body = std::make_shared<BodySpec>();
    AUREOLE_RETURN_IF_ERROR(Decode(in.spawn(), last, body.get()));
    out->spawn = std::move(body);
  } else if (out->kind == Input::Kind::kLayout) {
    auto change = std::make_shared<LayoutChange>();
    AUREOLE_RETURN_IF_ERROR(Decode(in.layout(), change.get()));
    out->layout = std::move(change);
  } else {
    out->body = in.body();
    AUREOLE_RETURN_IF_ERROR(Decode("linear", in.linear(), &out->linear));
    AUREOLE_RETURN_IF_ERROR(Decode("angular", in.angular(), &out->angular));
    AUREOLE_RETURN_IF_ERROR(Decode("point", in.point(), &out->point));
    if (in.frame() > static_cast<uint32_t>(Input::Frame::kBody)) return Bad("frame", "no such frame");
    out->frame = static_cast<Input::Frame>(in.frame());
    if (in.ticks() > static_cast<uint64_t>(kMostInputTicks)) return Bad("ticks", "too many");
    if (in.ticks() != 0) out->ticks = static_cast<Tick>(in.ticks());
    if (in.has_area() && !(in.area().radius() > 0)) return Bad("area.radius", "must be above 0");
    AUREOLE_RETURN_IF_ERROR(Decode("area.centre", in.area().centre(), &out->area.centre));
    out->area.radius = in.area().radius();
    out->area.outward = in.area().outward();
    out->area.fades = in.area().fades();
  }
  return CheckLiveInput(*out);
}

}  // namespace

void EncodeInputs(const std::vector<Input>& inputs, google::protobuf::RepeatedPtrField<v1::Input>* out) {
  const Shape* last = nullptr;
  for (const Input& input : inputs) {
    Encode(input, last, out->Add());
    if (input.spawn != nullptr) last = input.spawn->shape.get();
  }
}

absl::Status DecodeInputs(const google::protobuf::RepeatedPtrField<v1::Input>& in, std::vector<Input>* out) {
  std::shared_ptr<const Shape> last;
  out->clear();
  for (const v1::Input& input : in) {
    AUREOLE_RETURN_IF_ERROR(Decode(input, last, &out->emplace_back()));
    if (out->back().spawn != nullptr) last = out->back().spawn->shape;
  }
  return absl::OkStatus();
}

void RecordInputs(const std::vector<Input>& inputs, google::protobuf::RepeatedPtrField<v1::Input>* out) {
  const int before = out->size();
  EncodeInputs(inputs, out);
  for (size_t i = 0; i < inputs.size(); ++i) {
    v1::Input* told = out->Mutable(before + static_cast<int>(i));
    told->set_tick(inputs[i].tick);
    told->set_body(inputs[i].body);
  }
}

void EncodeLayoutChange(const LayoutChange& change, v1::LayoutChange* out) { Encode(change, out); }
absl::Status DecodeLayoutChange(const v1::LayoutChange& in, LayoutChange* out) { return Decode(in, out); }

absl::Status ReadRecordedInput(const v1::Input& in, Input* out) {
  AUREOLE_RETURN_IF_ERROR(Decode(in, nullptr, out));
  if (out->kind == Input::Kind::kLayout) return Bad("kind", "the layout changes nothing that is recorded");
  if (in.tick() < 1) return Bad("tick", "must be at least 1");
  out->tick = in.tick();
  if (out->kind != Input::Kind::kSpawn) return absl::OkStatus();
  if (!IsLiveId(in.body())) return Bad("body", absl::StrCat(in.body(), " is no id of a spawned body"));
  out->body = in.body();
  auto body = std::make_shared<BodySpec>(*out->spawn);
  body->id = out->body;
  out->spawn = std::move(body);
  return absl::OkStatus();
}

}  // namespace aureole
