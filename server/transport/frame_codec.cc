#include "server/transport/frame_codec.h"

#include <algorithm>
#include <cmath>

#include <absl/strings/str_cat.h>

#include "aureole/v1/peer.pb.h"
#include "server/core/check.h"
#include "server/core/limits.h"
#include "server/transport/input_codec.h"
#include "server/transport/link_limits.h"
#include "server/transport/return_if_error.h"

namespace aureole {
namespace {

using Ids = google::protobuf::RepeatedField<int64_t>;
using Floats = google::protobuf::RepeatedField<float>;
using Doubles = google::protobuf::RepeatedField<double>;

// ---- encoding ----

class IdWriter {
 public:
  explicit IdWriter(Ids* out) : out_(out) {}
  void Add(uint64_t id) {
    out_->Add(static_cast<int64_t>(id - last_));
    last_ = id;
  }

 private:
  Ids* out_;
  uint64_t last_ = 0;
};

void AddBox(const WireBox& box, Floats* out) {
  out->Add(std::begin(box.min), std::end(box.min));
  out->Add(std::begin(box.max), std::end(box.max));
}

void EncodeAuras(const std::vector<Aura>& auras, v1::Frame* out) {
  bool owners = false, bounds = false;
  for (const Aura& a : auras) {
    owners |= a.owner != kNoRegion;
    bounds |= a.group != 0 || a.energy != 0 || a.mass != 0;
  }
  IdWriter ids(out->mutable_aura_id());
  out->mutable_aura_box()->Reserve(static_cast<int>(6 * auras.size()));
  for (const Aura& a : auras) {
    ids.Add(a.id);
    AddBox(a.box, out->mutable_aura_box());
    if (owners) out->add_aura_owner(static_cast<uint32_t>(a.owner + 1));
    if (!bounds) continue;
    out->add_aura_group(static_cast<int64_t>(a.group - a.id));
    out->add_aura_energy(a.energy);
    out->add_aura_mass(a.mass);
  }
}

void EncodeFragment(const Fragment& f, v1::Frame::Fragment* out) {
  IdWriter known(out->mutable_known());
  for (BodyId id : f.known) known.Add(id);
  out->set_id(f.id);
  out->set_bodies(f.bodies);
  for (const auto& [region, mass] : f.mass_by_home) {
    out->add_home(static_cast<uint32_t>(region));
    out->add_mass(mass);
  }
  out->set_gives_back(static_cast<uint32_t>(f.gives_back + 1));
}

void EncodeGraph(const Graph& g, v1::Frame::Graph* out) {
  out->set_of(static_cast<uint32_t>(g.of));
  IdWriter edges(out->mutable_edge_a());
  for (const Edge& e : g.edges) {
    edges.Add(e.a);
    out->add_edge_step(e.b - e.a);
  }
  for (const Fragment& f : g.fragments) EncodeFragment(f, out->add_fragment());
  IdWriter late(out->mutable_late_id());
  for (const LateAura& l : g.late) {
    out->add_late_to(static_cast<uint32_t>(l.to));
    late.Add(l.aura.id);
    AddBox(l.aura.box, out->mutable_late_box());
  }
  for (RegionId r : g.opened) out->add_opened(static_cast<uint32_t>(r));
  for (RegionId r : g.closed) out->add_closed(static_cast<uint32_t>(r));
  EncodeInputs(g.inputs, out->mutable_input());
  for (const AppliedInput& a : g.applied) {
    out->add_applied_source(a.name.first);
    out->add_applied_sequence(a.name.second);
    out->add_applied_bodies(static_cast<uint64_t>(a.bodies));
  }
  out->set_emptied(g.emptied);
}

bool WithinLimits(const Graph& g) {
  return g.edges.size() <= kMaxEdges && g.fragments.size() <= kMaxFragments && g.late.size() <= kMaxAuras &&
         g.inputs.size() <= kMaxInputs && g.applied.size() <= kMaxApplied;
}

void EncodeTransfer(const Transfer& t, v1::Frame::Transfer* out) {
  AUREOLE_CHECK(t.ids.size() <= kMaxTransferBodies && t.pending.size() <= kMaxPending,
                "cluster of body %llu: %zu bodies, %zu pending inputs",
                static_cast<unsigned long long>(t.ids.empty() ? 0 : t.ids[0]), t.ids.size(), t.pending.size());
  IdWriter ids(out->mutable_id());
  for (BodyId id : t.ids) ids.Add(id);
  out->mutable_epoch()->Add(t.epochs.begin(), t.epochs.end());
  out->set_cause(static_cast<uint32_t>(t.cause));
  out->set_state(t.state);
  IdWriter spawns(out->mutable_spawn_body());
  for (const Input& input : t.pending) {
    AUREOLE_CHECK(input.kind == Input::Kind::kSpawn, "input %llu of source %llu in the transfer of body %llu",
                  static_cast<unsigned long long>(input.sequence), static_cast<unsigned long long>(input.source),
                  static_cast<unsigned long long>(input.body));
    out->add_spawn_tick(input.tick);
    spawns.Add(input.body);
  }
}

// ---- decoding ----

absl::Status Bad(const char* field, const std::string& what) {
  return absl::InvalidArgumentError(absl::StrCat("frame.", field, ": ", what));
}

absl::Status CheckCount(const char* field, int count, size_t limit) {
  if (static_cast<size_t>(count) > limit) {
    return Bad(field, absl::StrCat("has ", count, " entries, at most ", limit, " are allowed"));
  }
  return absl::OkStatus();
}

absl::Status CheckColumn(const char* field, int size, int per_entry, size_t entries, bool may_be_empty) {
  if (may_be_empty && size == 0) return absl::OkStatus();
  if (static_cast<size_t>(size) != per_entry * entries) {
    return Bad(field, absl::StrCat("has ", size, " values for ", entries, " entries of ", per_entry));
  }
  return absl::OkStatus();
}

absl::Status DecodeIds(const char* field, const Ids& in, size_t limit, bool ascending, std::vector<BodyId>* out) {
  AUREOLE_RETURN_IF_ERROR(CheckCount(field, in.size(), limit));
  out->reserve(in.size());
  uint64_t last = 0;
  for (int64_t step : in) {
    const uint64_t id = last + static_cast<uint64_t>(step);
    if (id == 0) return Bad(field, "0 is no id");
    if (ascending && id <= last) return Bad(field, absl::StrCat("body ", id, " after body ", last));
    out->push_back(last = id);
  }
  return absl::OkStatus();
}

absl::Status DecodeBox(const char* field, BodyId id, const float* in, WireBox* out) {
  for (int i = 0; i < 3; ++i) {
    out->min[i] = in[i];
    out->max[i] = in[3 + i];
    if (!std::isfinite(in[i]) || !std::isfinite(in[3 + i]) || in[i] > in[3 + i]) {
      return Bad(field, absl::StrCat("box of body ", id, " is inside out or not finite"));
    }
  }
  return absl::OkStatus();
}

absl::Status DecodeRegion(const char* field, uint32_t plus_one, RegionId* out) {
  if (plus_one > kMaxRegions) return Bad(field, absl::StrCat("no region ", plus_one - 1));
  *out = static_cast<RegionId>(plus_one) - 1;
  return absl::OkStatus();
}

absl::Status DecodeKnownRegion(const char* field, uint32_t region, RegionId* out) {
  if (region >= kMaxRegions) return Bad(field, absl::StrCat("no region ", region));
  *out = static_cast<RegionId>(region);
  return absl::OkStatus();
}

absl::Status DecodeAuras(const v1::Frame& in, std::vector<Aura>* out) {
  std::vector<BodyId> ids;
  AUREOLE_RETURN_IF_ERROR(DecodeIds("aura_id", in.aura_id(), kMaxAuras, false, &ids));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("aura_box", in.aura_box_size(), 6, ids.size(), false));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("aura_owner", in.aura_owner_size(), 1, ids.size(), true));
  const auto bounds = static_cast<size_t>(in.aura_group_size());
  AUREOLE_RETURN_IF_ERROR(CheckColumn("aura_group", in.aura_group_size(), 1, ids.size(), true));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("aura_energy", in.aura_energy_size(), 1, bounds, false));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("aura_mass", in.aura_mass_size(), 1, bounds, false));
  out->resize(ids.size());
  for (size_t i = 0; i < ids.size(); ++i) {
    Aura& a = (*out)[i];
    const int n = static_cast<int>(i);
    a.id = ids[i];
    AUREOLE_RETURN_IF_ERROR(DecodeBox("aura_box", a.id, in.aura_box().data() + 6 * i, &a.box));
    if (in.aura_owner_size() > 0) AUREOLE_RETURN_IF_ERROR(DecodeRegion("aura_owner", in.aura_owner(n), &a.owner));
    if (bounds == 0) continue;
    a.group = a.id + static_cast<uint64_t>(in.aura_group(n));
    a.energy = in.aura_energy(n);
    a.mass = in.aura_mass(n);
    if (!(a.energy >= 0)) return Bad("aura_energy", absl::StrCat("of body ", a.id));
    if (!(a.mass >= 0)) return Bad("aura_mass", absl::StrCat("of body ", a.id));
  }
  return absl::OkStatus();
}

absl::Status DecodeFragment(const v1::Frame::Fragment& in, Fragment* out) {
  AUREOLE_RETURN_IF_ERROR(DecodeIds("graph.fragment.known", in.known(), kMaxAuras, true, &out->known));
  if (out->known.empty()) return Bad("graph.fragment.known", "is empty");
  out->id = in.id();
  out->bodies = in.bodies();
  if (out->id == 0 || out->id > out->known[0])
    return Bad("graph.fragment.id", absl::StrCat(out->id, " is no smallest id"));
  if (out->bodies < out->known.size())
    return Bad("graph.fragment.bodies", absl::StrCat(out->bodies, ", more are named"));
  AUREOLE_RETURN_IF_ERROR(CheckCount("graph.fragment.home", in.home_size(), kMaxRegions));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("graph.fragment.mass", in.mass_size(), 1, in.home_size(), false));
  for (int i = 0; i < in.home_size(); ++i) {
    if (in.home(i) >= kMaxRegions || (i > 0 && in.home(i) <= in.home(i - 1))) {
      return Bad("graph.fragment.home", absl::StrCat(in.home(i), " is out of range or order"));
    }
    if (!std::isfinite(in.mass(i)) || in.mass(i) < 0)
      return Bad("graph.fragment.mass", absl::StrCat(in.mass(i), " kg"));
    out->mass_by_home.emplace_back(static_cast<RegionId>(in.home(i)), in.mass(i));
  }
  return DecodeRegion("graph.fragment.gives_back", in.gives_back(), &out->gives_back);
}

absl::Status DecodeEdges(const v1::Frame::Graph& in, std::vector<Edge>* out) {
  std::vector<BodyId> a;
  AUREOLE_RETURN_IF_ERROR(DecodeIds("graph.edge_a", in.edge_a(), kMaxEdges, false, &a));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("graph.edge_step", in.edge_step_size(), 1, a.size(), false));
  out->reserve(a.size());
  for (size_t i = 0; i < a.size(); ++i) {
    const uint64_t b = a[i] + in.edge_step(static_cast<int>(i));
    if (b <= a[i]) return Bad("graph.edge_step", absl::StrCat("edge of body ", a[i], " to body ", b));
    out->push_back({a[i], b});
  }
  return absl::OkStatus();
}

absl::Status DecodeLate(const v1::Frame::Graph& in, std::vector<LateAura>* out) {
  std::vector<BodyId> ids;
  AUREOLE_RETURN_IF_ERROR(DecodeIds("graph.late_id", in.late_id(), kMaxAuras, false, &ids));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("graph.late_to", in.late_to_size(), 1, ids.size(), false));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("graph.late_box", in.late_box_size(), 6, ids.size(), false));
  out->resize(ids.size());
  for (size_t i = 0; i < ids.size(); ++i) {
    LateAura& l = (*out)[i];
    l.aura.id = ids[i];
    AUREOLE_RETURN_IF_ERROR(DecodeKnownRegion("graph.late_to", in.late_to(static_cast<int>(i)), &l.to));
    AUREOLE_RETURN_IF_ERROR(DecodeBox("graph.late_box", ids[i], in.late_box().data() + 6 * i, &l.aura.box));
  }
  return absl::OkStatus();
}

absl::Status DecodeRegions(const char* field, const google::protobuf::RepeatedField<uint32_t>& in,
                           std::vector<RegionId>* out) {
  AUREOLE_RETURN_IF_ERROR(CheckCount(field, in.size(), kMaxRegions));
  for (uint32_t r : in) AUREOLE_RETURN_IF_ERROR(DecodeKnownRegion(field, r, &out->emplace_back()));
  return absl::OkStatus();
}

absl::Status DecodeGraph(const v1::Frame::Graph& in, Graph* out) {
  AUREOLE_RETURN_IF_ERROR(DecodeKnownRegion("graph.of", in.of(), &out->of));
  AUREOLE_RETURN_IF_ERROR(DecodeEdges(in, &out->edges));
  AUREOLE_RETURN_IF_ERROR(CheckCount("graph.fragment", in.fragment_size(), kMaxFragments));
  out->fragments.resize(in.fragment_size());
  for (int i = 0; i < in.fragment_size(); ++i) {
    AUREOLE_RETURN_IF_ERROR(DecodeFragment(in.fragment(i), &out->fragments[i]));
  }
  AUREOLE_RETURN_IF_ERROR(DecodeLate(in, &out->late));
  AUREOLE_RETURN_IF_ERROR(DecodeRegions("graph.opened", in.opened(), &out->opened));
  AUREOLE_RETURN_IF_ERROR(DecodeRegions("graph.closed", in.closed(), &out->closed));
  AUREOLE_RETURN_IF_ERROR(CheckCount("graph.input", in.input_size(), kMaxInputs));
  if (absl::Status s = DecodeInputs(in.input(), &out->inputs); !s.ok()) {
    return absl::InvalidArgumentError(absl::StrCat("frame.graph.", std::string(s.message())));
  }
  AUREOLE_RETURN_IF_ERROR(CheckCount("graph.applied_source", in.applied_source_size(), kMaxApplied));
  AUREOLE_RETURN_IF_ERROR(
      CheckColumn("graph.applied_sequence", in.applied_sequence_size(), 1, in.applied_source_size(), false));
  AUREOLE_RETURN_IF_ERROR(
      CheckColumn("graph.applied_bodies", in.applied_bodies_size(), 1, in.applied_source_size(), false));
  for (int i = 0; i < in.applied_source_size(); ++i) {
    if (in.applied_bodies(i) == 0 || in.applied_bodies(i) > static_cast<uint64_t>(limits::kMaxBodies)) {
      return Bad("graph.applied_bodies", absl::StrCat("no input acts on ", in.applied_bodies(i), " bodies"));
    }
    out->applied.push_back(
        {{in.applied_source(i), in.applied_sequence(i)}, static_cast<int64_t>(in.applied_bodies(i))});
  }
  out->emptied = in.emptied();
  return absl::OkStatus();
}

// Takes the state's bytes out of `in`.
absl::Status DecodeTransfer(v1::Frame::Transfer* in, Transfer* out) {
  AUREOLE_RETURN_IF_ERROR(DecodeIds("transfer.id", in->id(), kMaxTransferBodies, true, &out->ids));
  if (out->ids.empty()) return Bad("transfer.id", "is empty");
  AUREOLE_RETURN_IF_ERROR(CheckColumn("transfer.epoch", in->epoch_size(), 1, out->ids.size(), false));
  out->epochs.assign(in->epoch().begin(), in->epoch().end());
  if (in->cause() < static_cast<uint32_t>(TransferCause::kAuraCollision) ||
      in->cause() > static_cast<uint32_t>(TransferCause::kDrain)) {
    return Bad("transfer.cause", absl::StrCat("no cause ", in->cause()));
  }
  out->cause = static_cast<TransferCause>(in->cause());
  if (in->state().empty() && in->spawn_body_size() < in->id_size()) return Bad("transfer.state", "is empty");
  out->state = std::move(*in->mutable_state());
  std::vector<BodyId> spawns;
  AUREOLE_RETURN_IF_ERROR(DecodeIds("transfer.spawn_body", in->spawn_body(), kMaxPending, false, &spawns));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("transfer.spawn_tick", in->spawn_tick_size(), 1, spawns.size(), false));
  out->pending.resize(spawns.size());
  for (size_t i = 0; i < spawns.size(); ++i) {  // the receiver finds the rest in the script
    out->pending[i].kind = Input::Kind::kSpawn;
    out->pending[i].tick = in->spawn_tick(static_cast<int>(i));
    out->pending[i].body = spawns[i];
  }
  return absl::OkStatus();
}

// Bytes that this version does not know are not skipped: the handshake has settled the version.
bool HasUnknownFields(const google::protobuf::Message& message) {
  return !message.GetReflection()->GetUnknownFields(message).empty();
}

bool AnyUnknownFields(const v1::Frame& frame) {
  bool any = HasUnknownFields(frame);
  for (const auto& g : frame.graph()) {
    any |= HasUnknownFields(g);
    for (const auto& f : g.fragment()) any |= HasUnknownFields(f);
  }
  for (const auto& t : frame.transfer()) any |= HasUnknownFields(t);
  return any;
}

}  // namespace

std::string EncodeFrame(const Frame& frame) {
  AUREOLE_CHECK(frame.auras.size() <= kMaxAuras && frame.gone.size() <= kMaxAuras && frame.away.size() <= kMaxAuras &&
                    frame.away_gone.size() <= kMaxAuras && frame.graphs.size() <= kMaxRegions &&
                    std::all_of(frame.graphs.begin(), frame.graphs.end(), WithinLimits) &&
                    frame.transfers.size() <= kMaxTransfers,
                "frame of region %d, tick %lld is beyond link_limits.h: %zu auras, %zu graphs, %zu transfers",
                frame.from, static_cast<long long>(frame.tick), frame.auras.size(), frame.graphs.size(),
                frame.transfers.size());
  v1::Frame out;
  out.set_phase(static_cast<uint64_t>(frame.tick) * 8 + static_cast<uint64_t>(frame.round));
  EncodeAuras(frame.auras, &out);
  IdWriter gone(out.mutable_gone_id());
  for (BodyId id : frame.gone) gone.Add(id);
  for (const Graph& g : frame.graphs) EncodeGraph(g, out.add_graph());
  for (const Transfer& t : frame.transfers) EncodeTransfer(t, out.add_transfer());
  out.set_welcome(frame.welcome);
  IdWriter away(out.mutable_away_id());
  for (const Away& a : frame.away) {
    away.Add(a.id);
    out.add_away_owner(static_cast<uint32_t>(a.owner + 1));
    AddBox(a.box, out.mutable_away_box());
  }
  IdWriter away_gone(out.mutable_away_gone_id());
  for (BodyId id : frame.away_gone) away_gone.Add(id);
  AUREOLE_CHECK(out.ByteSizeLong() <= kMaxFrameBytes, "frame of region %d, tick %lld has %zu bytes", frame.from,
                static_cast<long long>(frame.tick), out.ByteSizeLong());
  return out.SerializeAsString();
}

absl::StatusOr<Frame> DecodeFrame(std::string_view bytes, RegionId from, RegionId to) {
  if (bytes.size() > kMaxFrameBytes)
    return absl::InvalidArgumentError(absl::StrCat("frame of ", bytes.size(), " bytes"));
  v1::Frame in;
  if (!in.ParseFromArray(bytes.data(), static_cast<int>(bytes.size()))) {
    return absl::InvalidArgumentError("frame: these bytes are not a Frame message");
  }
  if (AnyUnknownFields(in)) return absl::InvalidArgumentError("frame: has fields that this version does not know");

  Frame out;
  out.from = from;
  out.to = {to};
  out.round = static_cast<int>(in.phase() % 8);
  out.tick = static_cast<Tick>(in.phase() / 8);
  if (out.round > kWelcome) return Bad("phase", absl::StrCat("no round ", out.round));
  AUREOLE_RETURN_IF_ERROR(DecodeAuras(in, &out.auras));
  AUREOLE_RETURN_IF_ERROR(DecodeIds("gone_id", in.gone_id(), kMaxAuras, false, &out.gone));
  AUREOLE_RETURN_IF_ERROR(CheckCount("graph", in.graph_size(), kMaxRegions));
  out.graphs.resize(in.graph_size());
  for (int i = 0; i < in.graph_size(); ++i) AUREOLE_RETURN_IF_ERROR(DecodeGraph(in.graph(i), &out.graphs[i]));
  AUREOLE_RETURN_IF_ERROR(CheckCount("transfer", in.transfer_size(), kMaxTransfers));
  out.transfers.resize(in.transfer_size());
  for (int i = 0; i < in.transfer_size(); ++i) {
    AUREOLE_RETURN_IF_ERROR(DecodeTransfer(in.mutable_transfer(i), &out.transfers[i]));
  }
  out.welcome = std::move(*in.mutable_welcome());
  std::vector<BodyId> away;
  AUREOLE_RETURN_IF_ERROR(DecodeIds("away_id", in.away_id(), kMaxAuras, false, &away));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("away_owner", in.away_owner_size(), 1, away.size(), false));
  AUREOLE_RETURN_IF_ERROR(CheckColumn("away_box", in.away_box_size(), 6, away.size(), false));
  out.away.resize(away.size());
  for (size_t i = 0; i < away.size(); ++i) {
    Away& a = out.away[i];
    a.id = away[i];
    AUREOLE_RETURN_IF_ERROR(DecodeRegion("away_owner", in.away_owner(static_cast<int>(i)), &a.owner));
    AUREOLE_RETURN_IF_ERROR(DecodeBox("away_box", a.id, in.away_box().data() + 6 * i, &a.box));
  }
  AUREOLE_RETURN_IF_ERROR(DecodeIds("away_gone_id", in.away_gone_id(), kMaxAuras, false, &out.away_gone));
  return out;
}

}  // namespace aureole
