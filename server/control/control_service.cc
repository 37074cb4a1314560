#include "server/control/control_service.h"

#include <algorithm>
#include <deque>
#include <utility>

#include <absl/strings/str_cat.h>

#include "server/transport/input_codec.h"
#include "server/transport/world_spec.h"

namespace aureole {
namespace {

constexpr size_t kRecentReports = 5;    // of 200 ms: one second
constexpr size_t kMaxHashes = 1 << 20;  // 40 MB; an hour at every tick is a quarter of it
constexpr size_t kMaxWindows = 4096;    // 5.7 h
constexpr size_t kMaxViolations = 64;
constexpr std::chrono::milliseconds kLongestLeave = std::chrono::hours(24);

grpc::Status ToGrpc(const absl::Status& s) {
  return {static_cast<grpc::StatusCode>(s.code()), std::string(s.message())};
}

}  // namespace

// One server's stream. Its fields are guarded by the service's mutex; reactor calls are made under it, which is safe
// because gRPC runs reactions on its own threads, never inside of a call.
class ControlService::Session final : public grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion> {
 public:
  explicit Session(ControlService* service) : service_(service) {}

  void Begin() { StartRead(&in_); }

  // With the service's mutex.
  void Send(v1::ToRegion message) {
    if (closed_) return;
    message.set_control_epoch(service_->plan_.control_epoch);
    out_.push_back(std::move(message));
    if (out_.size() == 1) StartWrite(&out_.front());
  }
  void Close(const grpc::Status& status) {
    if (closed_) return;
    closed_ = true;
    Finish(status);
  }

  void OnReadDone(bool ok) override {
    if (!ok) {
      const std::lock_guard lock(service_->mutex_);
      Close(grpc::Status::OK);
      return;
    }
    const absl::Status s = service_->Handle(this, in_);
    const std::lock_guard lock(service_->mutex_);
    if (!s.ok()) {
      Close(ToGrpc(s));
    } else if (!closed_) {
      StartRead(&in_);
    }
  }
  void OnWriteDone(bool ok) override {
    const std::lock_guard lock(service_->mutex_);
    out_.pop_front();
    if (ok && !closed_ && !out_.empty()) StartWrite(&out_.front());
  }
  void OnCancel() override {
    const std::lock_guard lock(service_->mutex_);
    Close(grpc::Status::CANCELLED);
  }
  void OnDone() override {
    service_->Leave(this);
    delete this;
  }

  RegionId region = kNoRegion;  // after its Hello

 private:
  ControlService* const service_;
  v1::FromRegion in_;
  std::deque<v1::ToRegion> out_;  // the first one is being written
  bool closed_ = false;
};

ControlService::ControlService(RunPlan plan)
    : plan_(std::move(plan)),
      world_hash_(WorldHash(plan_.world)),
      layout_epoch_(plan_.layout_epoch),
      regions_(plan_.regions.size()) {
  for (size_t i = 0; i < regions_.size(); ++i) {
    const RunPlan::Region& from = plan_.regions[i];
    regions_[i].token = from.token;
    RegionStatus& status = regions_[i].status;
    status.incarnation = from.incarnation;
    status.was_ready = from.was_ready;
    status.ready_incarnation = from.ready_incarnation;
    status.keeper = from.keeper;
    status.endpoint = from.endpoint;
    status.member = from.member;
    regions_[i].joins = from.joins;
    regions_[i].retired = from.retired;
    status.reported = std::chrono::steady_clock::now();
  }
  start_unix_us_ = plan_.start_unix_us;
  if (start_unix_us_ != 0) stage_ = Stage::kRunning;
}

ControlService::~ControlService() {
  std::unique_lock lock(mutex_);
  changed_.wait(lock, [this] { return sessions_.empty(); });
}

grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* ControlService::Join(grpc::CallbackServerContext*) {
  const std::lock_guard lock(mutex_);
  auto* session = new Session(this);
  sessions_.insert(session);
  session->Begin();
  return session;
}

void ControlService::Close() {
  const std::lock_guard lock(mutex_);
  for (Session* session : sessions_) {
    session->Close({grpc::StatusCode::UNAVAILABLE, "this control plane leaves; join the next one"});
  }
}

RunStatus ControlService::Status() const {
  const std::lock_guard lock(mutex_);
  RunStatus out;
  out.stage = stage_;
  out.start_unix_us = start_unix_us_;
  for (const RegionRecord& record : regions_) out.regions.push_back(record.status);
  const auto whole =
      std::find_if(hashes_.rbegin(), hashes_.rend(), [](const auto& entry) { return entry.second.complete(); });
  if (whole != hashes_.rend()) out.hash = whole->second;
  return out;
}

std::vector<TickSum> ControlService::Hashes() const {
  const std::lock_guard lock(mutex_);
  std::vector<TickSum> out;
  for (const auto& [tick, sum] : hashes_) out.push_back(sum);
  return out;
}

std::vector<v1::Window> ControlService::Windows(RegionId region) const {
  const std::lock_guard lock(mutex_);
  const std::deque<v1::Window>& windows = regions_[region].windows;
  return {windows.begin(), windows.end()};
}

std::vector<v1::Violation> ControlService::Violations() const {
  const std::lock_guard lock(mutex_);
  return violations_;
}

void ControlService::Wait(std::chrono::milliseconds longest) {
  std::unique_lock lock(mutex_);
  changed_.wait_for(lock, longest, [this] { return changes_ != seen_; });
  seen_ = changes_;
}

void ControlService::Changed() {
  ++changes_;
  changed_.notify_all();
}

void ControlService::Stop(const std::string& reason) {
  v1::ToRegion message;
  message.mutable_stop()->set_reason(reason);
  const std::lock_guard lock(mutex_);
  for (RegionRecord& record : regions_) {
    if (record.session != nullptr) record.session->Send(message);
  }
}

void ControlService::Leave(Session* session) {
  const std::lock_guard lock(mutex_);
  sessions_.erase(session);
  if (session->region != kNoRegion && regions_[session->region].session == session) {
    regions_[session->region].session = nullptr;
    regions_[session->region].status.left = true;
    regions_[session->region].status.reported = std::chrono::steady_clock::now();
  }
  Changed();
}

absl::Status ControlService::Handle(Session* session, const v1::FromRegion& message) {
  const std::lock_guard lock(mutex_);
  if (message.has_hello()) return HandleHello(session, message.hello());
  if (session->region == kNoRegion) return absl::FailedPreconditionError("the first message must be a Hello");
  RegionRecord* record = &regions_[session->region];
  if (record->session != session) return absl::FailedPreconditionError("this server has been replaced");
  switch (message.message_case()) {
    case v1::FromRegion::kReady:
      return HandleReady(session->region, message.ready());
    case v1::FromRegion::kReport:
      return HandleReport(record, message.report());
    case v1::FromRegion::kLayoutOutcome:
      layout_outcome_ = message.layout_outcome();
      Changed();
      return absl::OkStatus();
    case v1::FromRegion::kGoodbye:
      record->status.goodbye = message.goodbye().reason();
      record->status.gone = message.goodbye().left();
      return absl::OkStatus();
    case v1::FromRegion::kLeaving:
      record->status.asks_to_leave = true;
      record->status.leaves_by =
          std::chrono::steady_clock::now() +
          std::min(std::chrono::milliseconds(std::max<int64_t>(0, message.leaving().within_ms())), kLongestLeave);
      Changed();
      return absl::OkStatus();
    default:
      return absl::InvalidArgumentError("a message of no known kind; the protocol versions differ");
  }
}

absl::Status ControlService::HandleHello(Session* session, const v1::Hello& hello) {
  if (session->region != kNoRegion) return absl::FailedPreconditionError("a second Hello on one stream");
  if (hello.protocol_version() != kControlProtocolVersion) {
    return absl::FailedPreconditionError(absl::StrCat("hello.protocol_version: is ", hello.protocol_version(),
                                                      ", must be ", kControlProtocolVersion,
                                                      "; use the region server of this release"));
  }
  if (hello.endpoint().empty()) return absl::InvalidArgumentError("hello.endpoint: is empty; give host:port");
  const auto found = std::find_if(regions_.begin(), regions_.end(),
                                  [&hello](const RegionRecord& r) { return r.token == hello.token(); });
  if (found == regions_.end() || hello.token().empty()) {
    return absl::UnauthenticatedError("hello.token: is not one of this run, or of a server that has been replaced");
  }
  const RegionId region = static_cast<RegionId>(found - regions_.begin());
  RegionRecord& record = *found;
  if (hello.has_running()) {
    if (absl::Status s = HandleRunning(record, hello.running()); !s.ok()) return s;
  } else if (record.session != nullptr || record.assigned) {
    return absl::AlreadyExistsError(absl::StrCat("hello.token: region ", region, " has joined already"));
  }
  // The stream before may not have been seen to end.
  if (record.session != nullptr) record.session->Close({grpc::StatusCode::ABORTED, "this server has joined again"});
  session->region = region;
  record.session = session;
  record.status.joined = true;
  record.status.left = false;
  record.status.goodbye.clear();
  record.status.endpoint = hello.endpoint();
  record.status.metrics_endpoint = hello.metrics_endpoint();
  record.status.pid = hello.pid();
  record.status.reported = std::chrono::steady_clock::now();
  if (hello.has_running()) {
    Resume(region, hello.running());
  } else if (stage_ != Stage::kJoining) {
    Assign(region);
  }
  if (stage_ == Stage::kJoining &&
      std::all_of(regions_.begin(), regions_.end(), [](const RegionRecord& r) { return r.status.joined; })) {
    AssignAll();
  }
  Changed();
  return absl::OkStatus();
}

// Of a server that joins again: nothing changes here.
absl::Status ControlService::HandleRunning(const RegionRecord& record, const v1::Running& running) const {
  const auto region = static_cast<RegionId>(&record - regions_.data());
  if (running.region() != region || running.incarnation() != record.status.incarnation) {
    return absl::FailedPreconditionError(absl::StrCat("hello.running: is incarnation ", running.incarnation(),
                                                      " of region ", running.region(), ", its token is of incarnation ",
                                                      record.status.incarnation, " of region ", region));
  }
  if (running.world_hash() != world_hash_) {
    return absl::FailedPreconditionError("hello.running.world_hash: is of another world");
  }
  if (running.tick() < record.status.report.tick()) {
    return absl::InvalidArgumentError(absl::StrCat("hello.running.tick: is ", running.tick(), " after ",
                                                   record.status.report.tick(), "; time does not run back"));
  }
  return absl::OkStatus();
}

// What happened while it was away it is told now.
void ControlService::Resume(RegionId region, const v1::Running& running) {
  RegionRecord& record = regions_[region];
  record.assigned = record.status.ready = record.status.was_ready = true;
  record.status.ready_incarnation = running.incarnation();
  record.status.report.set_tick(running.tick());
  record.status.report.set_bodies(running.bodies());
  for (size_t i = 0; i < regions_.size(); ++i) {
    const auto peer = static_cast<RegionId>(i);
    if (peer != region && !regions_[i].status.endpoint.empty()) record.session->Send(Moved(peer));
  }
  if (start_unix_us_ == 0) start_unix_us_ = running.start_unix_us();
  if (start_unix_us_ != 0) {
    stage_ = std::max(stage_, Stage::kRunning);
    if (running.start_unix_us() == 0) Start(&record);
  } else {
    CheckReady();
  }
}

void ControlService::AssignAll() {
  stage_ = Stage::kLoading;
  for (size_t i = 0; i < regions_.size(); ++i) {
    if (!regions_[i].assigned) Assign(static_cast<RegionId>(i));
  }
  CheckReady();
}

void ControlService::Assign(RegionId region) {
  RegionRecord& to = regions_[region];
  if (to.session == nullptr) return;
  v1::ToRegion message;
  v1::Assignment* a = message.mutable_assignment();
  *a->mutable_world() = plan_.world;
  for (const RegionRecord& record : regions_) {
    a->add_endpoints(record.retired ? "" : record.status.endpoint);
    a->add_incarnations(record.retired ? 0 : record.status.incarnation);
  }
  if (to.joins.has_value()) *a->mutable_join() = *to.joins;
  a->set_region(region);
  a->set_layout_epoch(layout_epoch_);
  a->set_incarnation(to.status.incarnation);
  a->set_checkpoint_every(plan_.checkpoint_every);
  a->set_recover(to.status.was_ready);
  a->set_ready_incarnation(to.status.ready_incarnation);
  a->set_keeper(to.status.keeper);
  a->set_volume_from(to.status.report.volume_from());
  a->set_copy_from(to.status.report.copy_from());
  a->set_undivided(plan_.undivided);
  a->set_no_real_time(plan_.no_real_time);
  a->set_last_tick(plan_.last_tick);
  a->set_hash_every(plan_.hash_every);
  to.assigned = true;
  to.session->Send(std::move(message));
}

void ControlService::Expect(RegionId region, uint64_t incarnation, const std::string& token) {
  const std::lock_guard lock(mutex_);
  RegionRecord& record = regions_[region];
  if (record.session != nullptr) {
    record.session->Close({grpc::StatusCode::FAILED_PRECONDITION, "this server has been replaced"});
  }
  if (stage_ == Stage::kReady) stage_ = Stage::kLoading;
  record.session = nullptr;
  record.token = token;
  record.assigned = false;
  record.recent.clear();
  RegionStatus& status = record.status;
  status.incarnation = incarnation;
  status.joined = status.ready = status.finished = status.left = false;
  status.goodbye.clear();
  status.gone = status.asks_to_leave = false;
  status.leaves_by.reset();
  status.fetched.clear();
  status.pid = 0;
  status.reported = std::chrono::steady_clock::now();
  // From here on nobody listens to the one before, wherever the next one has its checkpoint from.
  if (status.was_ready && !status.endpoint.empty()) TellMoved(region);
  Changed();
}

v1::ToRegion ControlService::Moved(RegionId region) const {
  v1::ToRegion message;
  v1::PeerMoved* moved = message.mutable_peer_moved();
  moved->set_region(region);
  moved->set_endpoint(regions_[region].status.endpoint);
  moved->set_incarnation(regions_[region].status.incarnation);
  const std::optional<v1::LayoutChange>& joins = regions_[region].joins;
  if (joins.has_value() && joins->epoch() > layout_epoch_) moved->set_joins(joins->epoch());
  return message;
}

// A server that was told the endpoint before it was there has to find the new one.
void ControlService::TellMoved(RegionId region) {
  const v1::ToRegion message = Moved(region);
  for (size_t i = 0; i < regions_.size(); ++i) {
    const bool told = regions_[i].assigned && static_cast<RegionId>(i) != region;
    if (told && regions_[i].session != nullptr) regions_[i].session->Send(message);
  }
}

absl::Status ControlService::HandleReady(RegionId region, const v1::Ready& ready) {
  RegionRecord* const record = &regions_[region];
  if (!record->assigned || record->status.ready) {
    return absl::FailedPreconditionError("a Ready before the Assignment, or a second one");
  }
  record->status.ready = record->status.was_ready = true;
  record->status.report.set_bodies(ready.bodies());
  record->status.ready_incarnation = record->status.incarnation;
  record->status.fetched = ready.fetched();
  record->status.report.set_tick(ready.tick());
  // What it has gone on from is all that its peers keep frames for, and what it makes of it need not be what another
  // one would make of the copy.
  record->status.report.set_volume_from(ready.tick());
  record->status.report.set_copy_from(ready.fetched().empty() ? ready.tick() + 1 : ready.tick());
  record->status.report.clear_waiting_for();
  if (record->status.incarnation > 1 || record->joins.has_value()) TellMoved(region);
  // Those that are to join it must know before the world hears of them.
  for (size_t i = 0; i < regions_.size(); ++i) {
    const auto other = static_cast<RegionId>(i);
    const bool joins = !regions_[i].status.member && regions_[i].joins.has_value();
    if (joins && regions_[i].status.ready && other != region) record->session->Send(Moved(other));
  }
  if (stage_ == Stage::kRunning) {
    Start(record);
  } else {
    CheckReady();
  }
  Changed();
  return absl::OkStatus();
}

void ControlService::CheckReady() {
  if (stage_ == Stage::kLoading &&
      std::all_of(regions_.begin(), regions_.end(), [](const RegionRecord& r) { return r.status.ready; })) {
    stage_ = Stage::kReady;
  }
}

void ControlService::StartAll(int64_t start_unix_us) {
  const std::lock_guard lock(mutex_);
  if (stage_ != Stage::kReady) return;  // a server has died since
  stage_ = Stage::kRunning;
  start_unix_us_ = start_unix_us;
  for (RegionRecord& record : regions_) Start(&record);
  Changed();
}

void ControlService::Start(RegionRecord* record) {
  record->status.reported = std::chrono::steady_clock::now();
  v1::ToRegion message;
  message.mutable_start()->set_start_unix_us(start_unix_us_);
  if (record->session != nullptr) record->session->Send(std::move(message));
}

absl::Status ControlService::HandleReport(RegionRecord* record, const v1::Report& report) {
  RegionStatus& status = record->status;
  if (stage_ != Stage::kRunning) return absl::FailedPreconditionError("a Report before the Start");
  if (status.finished) return absl::OkStatus();  // who joins again says its last report again
  if (report.tick() < status.report.tick()) {
    return absl::InvalidArgumentError(
        absl::StrCat("report.tick: is ", report.tick(), " after ", status.report.tick(), "; time does not run back"));
  }
  Tick last_hash = -1;
  for (const v1::TickHash& h : report.hashes()) {
    if (h.tick() <= last_hash) return absl::InvalidArgumentError("report.hashes: ticks must ascend");
    last_hash = h.tick();
  }
  for (const v1::TickHash& h : report.hashes()) {
    if (h.tick() <= record->last_hash) continue;  // said again, or by the server before it
    record->last_hash = h.tick();
    TickSum& sum = hashes_[h.tick()];
    sum.tick = h.tick();
    sum.hash += h.hash();
    sum.members = h.members();
    sum.bodies += h.bodies();
    ++sum.regions;
  }
  while (hashes_.size() > kMaxHashes) hashes_.erase(hashes_.begin());
  for (const v1::Window& w : report.windows()) record->windows.push_back(w);
  while (record->windows.size() > kMaxWindows) record->windows.pop_front();
  for (const v1::Violation& v : report.violation_log()) {
    if (violations_.size() < kMaxViolations) violations_.push_back(v);
  }

  const auto now = std::chrono::steady_clock::now();
  const double seconds = std::chrono::duration<double>(now - status.reported).count();
  if (seconds > 0.01) {  // two reports may come together, the last and the one before
    status.bytes_per_second = static_cast<double>(report.bytes_sent() - status.report.bytes_sent()) / seconds;
  }
  if (report.frame().ticks() > 0) record->recent.push_back(report.frame());
  if (record->recent.size() > kRecentReports) record->recent.pop_front();
  status.frame = Merge(record->recent);
  status.reported = now;
  status.report = report;
  if (report.keeper() != 0) status.keeper = report.keeper();
  status.report.clear_hashes();
  status.report.clear_windows();
  status.report.clear_violation_log();
  status.finished = report.finished();
  if (status.finished) {
    CheckFinished();
    Changed();
  }
  return absl::OkStatus();
}

void ControlService::CheckFinished() {
  if (std::all_of(regions_.begin(), regions_.end(),
                  [](const RegionRecord& r) { return r.status.finished || !r.status.member; })) {
    stage_ = Stage::kFinished;
  }
}

void ControlService::Admit(RegionId region, const LayoutChange& layout) {
  const std::lock_guard lock(mutex_);
  if (static_cast<size_t>(region) >= regions_.size()) regions_.resize(static_cast<size_t>(region) + 1);
  RegionRecord& record = regions_[static_cast<size_t>(region)];
  const uint64_t incarnation = record.status.incarnation;
  record.status = {};
  record.status.incarnation = incarnation;
  record.status.member = false;
  record.status.reported = std::chrono::steady_clock::now();
  record.assigned = record.retired = false;
  EncodeLayoutChange(layout, &record.joins.emplace());
  Changed();
}

void ControlService::Dismiss(RegionId region, const std::string& reason) {
  v1::ToRegion message;
  message.mutable_stop()->set_reason(reason);
  const std::lock_guard lock(mutex_);
  RegionRecord& record = regions_[static_cast<size_t>(region)];
  if (record.session != nullptr) record.session->Send(std::move(message));
}

void ControlService::Retire(RegionId region) {
  v1::ToRegion message;
  message.mutable_peer_left()->set_region(region);
  const std::lock_guard lock(mutex_);
  RegionRecord& gone = regions_[static_cast<size_t>(region)];
  gone.retired = true;
  gone.joins.reset();
  gone.status.leaves_by.reset();
  gone.status.endpoint.clear();
  gone.status.report.Clear();
  gone.status.member = gone.status.ready = false;
  for (RegionRecord& record : regions_) {
    if (&record != &gone && record.assigned && record.session != nullptr) record.session->Send(message);
  }
  Changed();
}

void ControlService::ChangeLayout(RegionId to, uint64_t sequence, const LayoutChange& layout) {
  v1::ToRegion message;
  message.mutable_change_layout()->set_sequence(sequence);
  EncodeLayoutChange(layout, message.mutable_change_layout()->mutable_layout());
  const std::lock_guard lock(mutex_);
  RegionRecord& record = regions_[static_cast<size_t>(to)];
  if (record.session != nullptr && record.status.ready) record.session->Send(std::move(message));
}

void ControlService::SaveCheckpoint(RegionId region, Tick tick) {
  v1::ToRegion message;
  message.mutable_save_checkpoint()->set_tick(tick);
  const std::lock_guard lock(mutex_);
  RegionRecord& record = regions_[static_cast<size_t>(region)];
  if (record.session != nullptr && record.status.ready) record.session->Send(std::move(message));
}

std::optional<v1::LayoutOutcome> ControlService::TakeLayoutOutcome() {
  const std::lock_guard lock(mutex_);
  return std::exchange(layout_outcome_, std::nullopt);
}

void ControlService::AnswerLeaving(RegionId region, const std::string& refused) {
  v1::ToRegion message;
  message.mutable_leaving_answer()->set_refused(refused);
  const std::lock_guard lock(mutex_);
  RegionRecord& record = regions_[static_cast<size_t>(region)];
  record.status.asks_to_leave = false;
  if (!refused.empty()) record.status.leaves_by.reset();
  if (record.session != nullptr) record.session->Send(std::move(message));
}

void ControlService::SetLayout(const LayoutChange& layout) {
  const std::lock_guard lock(mutex_);
  layout_epoch_ = layout.epoch;
  for (size_t i = 0; i < regions_.size(); ++i) {
    regions_[i].status.member =
        std::binary_search(layout.members.begin(), layout.members.end(), static_cast<RegionId>(i));
  }
  Changed();
}

}  // namespace aureole
