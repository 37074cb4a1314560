#include "server/control/control_service.h"

#include <algorithm>
#include <deque>
#include <utility>

#include <absl/strings/str_cat.h>

namespace aureole {
namespace {

constexpr size_t kRecentReports = 5;    // of 200 ms: one second
constexpr size_t kMaxHashes = 1 << 20;  // 40 MB; an hour at every tick is a quarter of it
constexpr size_t kMaxWindows = 4096;    // 5.7 h
constexpr size_t kMaxViolations = 64;

grpc::Status ToGrpc(const absl::Status& s) {
  return {static_cast<grpc::StatusCode>(s.code()), std::string(s.message())};
}

}  // namespace

// One server's stream. Its fields are guarded by the service's mutex; reactor calls are made under it, which is safe
// because gRPC runs reactions on its own threads, never inside of a call.
class ControlService::Session final : public grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion> {
 public:
  explicit Session(ControlService* service) : service_(service) { StartRead(&in_); }

  // With the service's mutex.
  void Send(v1::ToRegion message) {
    if (closed_) return;
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

ControlService::ControlService(RunPlan plan) : plan_(std::move(plan)), regions_(plan_.tokens.size()) {
  for (size_t i = 0; i < regions_.size(); ++i) {
    regions_[i].token = plan_.tokens[i];
    regions_[i].status.reported = std::chrono::steady_clock::now();
  }
}

ControlService::~ControlService() {
  std::unique_lock lock(mutex_);
  changed_.wait(lock, [this] { return sessions_ == 0; });
}

grpc::ServerBidiReactor<v1::FromRegion, v1::ToRegion>* ControlService::Join(grpc::CallbackServerContext*) {
  const std::lock_guard lock(mutex_);
  ++sessions_;
  return new Session(this);
}

RunStatus ControlService::Status() const {
  const std::lock_guard lock(mutex_);
  RunStatus out;
  out.stage = stage_;
  for (const RegionRecord& record : regions_) out.regions.push_back(record.status);
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
  --sessions_;
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
    case v1::FromRegion::kGoodbye:
      record->status.goodbye = message.goodbye().reason();
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
  if (record.status.joined) {
    return absl::AlreadyExistsError(absl::StrCat("hello.token: region ", region, " has joined already"));
  }
  session->region = region;
  record.session = session;
  record.status.joined = true;
  record.status.endpoint = hello.endpoint();
  record.status.metrics_endpoint = hello.metrics_endpoint();
  record.status.pid = hello.pid();
  record.status.reported = std::chrono::steady_clock::now();
  if (stage_ != Stage::kJoining) {
    Assign(region);
  } else if (std::all_of(regions_.begin(), regions_.end(), [](const RegionRecord& r) { return r.status.joined; })) {
    AssignAll();
  }
  Changed();
  return absl::OkStatus();
}

void ControlService::AssignAll() {
  stage_ = Stage::kLoading;
  for (size_t i = 0; i < regions_.size(); ++i) Assign(static_cast<RegionId>(i));
}

void ControlService::Assign(RegionId region) {
  RegionRecord& to = regions_[region];
  if (to.session == nullptr) return;
  v1::ToRegion message;
  v1::Assignment* a = message.mutable_assignment();
  *a->mutable_world() = plan_.world;
  for (const RegionRecord& record : regions_) {
    a->add_endpoints(record.status.endpoint);
    a->add_incarnations(record.status.incarnation);
  }
  a->set_region(region);
  a->set_layout_epoch(1);
  a->set_incarnation(to.status.incarnation);
  a->set_checkpoint_every(plan_.checkpoint_every);
  a->set_recover(to.was_ready);
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
  record.session = nullptr;
  record.token = token;
  record.assigned = false;
  record.recent.clear();
  RegionStatus& status = record.status;
  status.incarnation = incarnation;
  status.joined = status.ready = status.finished = status.left = false;
  status.goodbye.clear();
  status.pid = 0;
  status.reported = std::chrono::steady_clock::now();
  Changed();
}

// A server that was told the endpoint before it was there has to find the new one.
void ControlService::TellMoved(RegionId region) {
  v1::ToRegion message;
  v1::PeerMoved* moved = message.mutable_peer_moved();
  moved->set_region(region);
  moved->set_endpoint(regions_[region].status.endpoint);
  moved->set_incarnation(regions_[region].status.incarnation);
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
  record->status.ready = true;
  record->was_ready = true;
  record->session_hash = -1;
  record->status.report.set_bodies(ready.bodies());
  record->status.report.set_tick(ready.tick());
  record->status.report.clear_waiting_for();
  if (record->status.incarnation > 1) TellMoved(region);
  if (stage_ == Stage::kRunning) {
    Start(record);
  } else if (std::all_of(regions_.begin(), regions_.end(), [](const RegionRecord& r) { return r.status.ready; })) {
    StartAll();
  }
  Changed();
  return absl::OkStatus();
}

void ControlService::StartAll() {
  stage_ = Stage::kRunning;
  const auto start = std::chrono::system_clock::now() + plan_.start_delay;
  start_unix_us_ = std::chrono::duration_cast<std::chrono::microseconds>(start.time_since_epoch()).count();
  for (RegionRecord& record : regions_) Start(&record);
}

void ControlService::Start(RegionRecord* record) {
  record->status.reported = std::chrono::steady_clock::now();
  v1::ToRegion message;
  message.mutable_start()->set_start_unix_us(start_unix_us_);
  if (record->session != nullptr) record->session->Send(std::move(message));
}

absl::Status ControlService::HandleReport(RegionRecord* record, const v1::Report& report) {
  RegionStatus& status = record->status;
  if (stage_ != Stage::kRunning || status.finished) {
    return absl::FailedPreconditionError("a Report before the Start, or after the last one");
  }
  if (report.tick() < status.report.tick()) {
    return absl::InvalidArgumentError(
        absl::StrCat("report.tick: is ", report.tick(), " after ", status.report.tick(), "; time does not run back"));
  }
  Tick last_hash = record->session_hash;
  for (const v1::TickHash& h : report.hashes()) {
    if (h.tick() <= last_hash) return absl::InvalidArgumentError("report.hashes: ticks must ascend");
    last_hash = h.tick();
  }
  record->session_hash = last_hash;
  for (const v1::TickHash& h : report.hashes()) {
    if (h.tick() <= record->last_hash) continue;  // the server before it has said so
    record->last_hash = h.tick();
    TickSum& sum = hashes_[h.tick()];
    sum.tick = h.tick();
    sum.hash += h.hash();
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
  status.report.clear_hashes();
  status.report.clear_windows();
  status.report.clear_violation_log();
  status.finished = report.finished();
  if (status.finished) {
    if (std::all_of(regions_.begin(), regions_.end(), [](const RegionRecord& r) { return r.status.finished; })) {
      stage_ = Stage::kFinished;
    }
    Changed();
  }
  return absl::OkStatus();
}

}  // namespace aureole
