#include "server/region/region_links.h"

#include <algorithm>
#include <utility>

#include "server/transport/frame_codec.h"

namespace aureole {
namespace {

bool Contains(const std::vector<RegionId>& list, RegionId r) { return std::binary_search(list.begin(), list.end(), r); }

void Add(const LinkStats& s, LinkStats* sum) {
  sum->frames_sent += s.frames_sent;
  sum->frames_received += s.frames_received;
  sum->frames_kept += s.frames_kept;
  sum->bytes_sent += s.bytes_sent;
  sum->connections += s.connections;
  sum->reconnects += s.reconnects;
  sum->refused_hellos += s.refused_hellos;
  sum->refused_frames += s.refused_frames;
  sum->duplicates += s.duplicates;
}

}  // namespace

RegionLinks::RegionLinks(const LinkIdentity& identity, const std::vector<RegionId>& peers,
                         std::function<void(RegionId, const std::string&)> log, bool keep,
                         std::map<RegionId, LinkState> states)
    : identity_(identity), keep_(keep), log_(std::move(log)) {
  for (auto& [peer, state] : states) {
    const uint64_t epoch = state.epoch;
    Make(peer, epoch, std::move(state));
  }
  for (RegionId peer : peers) {
    if (!links_.contains(peer)) Make(peer, identity_.layout_epoch);
  }
  for (auto& [peer, made] : links_) made.member = Contains(peers, peer);
}

RegionLinks::~RegionLinks() { Close(); }

// Holds the mutex.
void RegionLinks::Make(RegionId peer, uint64_t epoch, LinkState state) {
  LinkIdentity identity = identity_;
  identity.layout_epoch = epoch;
  const auto deliver = [this](Frame frame) {
    bool enough = false;
    {
      const std::lock_guard lock(mutex_);
      mailbox_.push_back(std::move(frame));
      enough = mailbox_.size() >= awaited_;
    }
    if (enough) arrived_.notify_one();
  };
  Peer& made = links_[peer];
  made.link = std::make_unique<PeerLink>(PeerLink::Options{identity, peer, deliver, log_, keep_, std::move(state)});
  made.link->Redirect("", addresses_[peer].incarnation);
  if (service_ != nullptr) Attach(&made);
}

// Holds the mutex. Of a pair the lower one dials.
void RegionLinks::Attach(Peer* peer) {
  const RegionId id = peer->link->peer();
  if (id < identity_.self) return service_->Add(peer->link.get());
  const std::string& endpoint = addresses_[id].endpoint;
  if (peer->dialled || endpoint.empty()) return;
  peer->dialled = true;
  peer->link->Dial(endpoint, credentials_);
}

// Holds the mutex. The link is for the caller to close, without it.
std::unique_ptr<PeerLink> RegionLinks::Take(std::map<RegionId, Peer>::iterator peer) {
  std::unique_ptr<PeerLink> link = std::move(peer->second.link);
  if (service_ != nullptr) service_->Remove(link.get());
  LinkStats stats = link->stats();
  stats.frames_kept = 0;
  Add(stats, &gone_);
  links_.erase(peer);
  return link;
}

void RegionLinks::Connect(PeerService* service, const std::vector<std::string>& endpoints,
                          const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  const std::lock_guard lock(links_mutex_);
  service_ = service;
  credentials_ = credentials;
  for (size_t r = 0; r < endpoints.size(); ++r) addresses_[static_cast<RegionId>(r)].endpoint = endpoints[r];
  service->Serve(identity_, {});
  for (auto& [peer, made] : links_) Attach(&made);
}

void RegionLinks::Redirect(RegionId peer, const std::string& endpoint, uint64_t incarnation) {
  const std::lock_guard lock(links_mutex_);
  Address& address = addresses_[peer];
  if (incarnation < address.incarnation) return;
  address.incarnation = incarnation;
  if (!endpoint.empty()) address.endpoint = endpoint;
  const auto found = links_.find(peer);
  if (found == links_.end()) return;
  found->second.link->Redirect(endpoint, incarnation);
  if (service_ != nullptr) Attach(&found->second);
}

void RegionLinks::Expect(RegionId peer, uint64_t epoch) {
  std::unique_ptr<PeerLink> old;
  const std::lock_guard lock(links_mutex_);
  const auto found = links_.find(peer);
  if (found != links_.end()) {
    if (found->second.member || found->second.link->epoch() >= epoch) return;
    old = Take(found);
  }
  Make(peer, epoch);
  links_.at(peer).member = false;
}

void RegionLinks::Forget(RegionId peer) {
  std::unique_ptr<PeerLink> old;
  const std::lock_guard lock(links_mutex_);
  const auto found = links_.find(peer);
  if (found != links_.end() && !found->second.member) old = Take(found);
}

void RegionLinks::Follow(uint64_t epoch, const std::vector<RegionId>& members,
                         const std::vector<RegionId>& next_members) {
  std::vector<std::unique_ptr<PeerLink>> old;
  const std::lock_guard lock(links_mutex_);
  for (auto& [peer, made] : links_) {
    made.member = Contains(members, peer) || Contains(next_members, peer);
    if (!made.member && made.link->epoch() <= epoch) made.link->Part();
  }
  for (RegionId peer : next_members) {
    if (peer == identity_.self || Contains(members, peer)) continue;
    const auto found = links_.find(peer);
    if (found != links_.end() && found->second.link->epoch() > epoch) continue;
    if (found != links_.end()) old.push_back(Take(found));
    Make(peer, epoch + 1);
  }
}

void RegionLinks::Part() {
  const std::lock_guard lock(links_mutex_);
  for (auto& [peer, made] : links_) made.link->Part();
}

void RegionLinks::Unmet(std::vector<RegionId>* out) const {
  const std::lock_guard lock(links_mutex_);
  for (const auto& [peer, made] : links_) {
    if (made.member && !made.link->met()) out->push_back(peer);
  }
}

bool RegionLinks::released() const {
  const std::lock_guard lock(links_mutex_);
  return std::all_of(links_.begin(), links_.end(), [](const auto& made) { return made.second.link->released(); });
}

void RegionLinks::SetDurable(const std::map<RegionId, LinkMark>& frames) {
  const std::lock_guard lock(links_mutex_);
  for (const auto& [peer, mark] : frames) {
    const auto found = links_.find(peer);
    if (found != links_.end() && found->second.link->epoch() == mark.epoch) {
      found->second.link->SetDurable(mark.frames);
    }
  }
}

std::map<RegionId, LinkState> RegionLinks::States() const {
  const std::lock_guard lock(links_mutex_);
  std::map<RegionId, LinkState> out;
  for (const auto& [peer, made] : links_) out[peer] = made.link->State();
  return out;
}

Tick RegionLinks::log_until() const {
  const std::lock_guard lock(links_mutex_);
  Tick out = identity_.log_until;
  for (const auto& [peer, made] : links_) out = std::max(out, made.link->log_until());
  return out;
}

bool RegionLinks::caught_up() const {
  const std::lock_guard lock(links_mutex_);
  return std::all_of(links_.begin(), links_.end(),
                     [](const auto& made) { return !made.second.member || made.second.link->caught_up(); });
}

std::vector<std::string> RegionLinks::Endpoints() const {
  const std::lock_guard lock(links_mutex_);
  std::vector<std::string> out;
  for (const auto& [region, address] : addresses_) {
    out.resize(std::max(out.size(), static_cast<size_t>(region) + 1));
    if (region != identity_.self) out[static_cast<size_t>(region)] = address.endpoint;
  }
  return out;
}

void RegionLinks::Send(const std::vector<Frame>& frames) {
  const std::lock_guard lock(links_mutex_);
  for (const Frame& frame : frames) {
    const auto bytes = std::make_shared<const std::string>(EncodeFrame(frame));
    for (RegionId to : frame.to) links_.at(to).link->Send(bytes);
  }
}

void RegionLinks::Receive(size_t at_least, Clock::time_point deadline, std::vector<Frame>* out) {
  out->clear();
  std::unique_lock lock(mutex_);
  awaited_ = at_least;
  arrived_.wait_until(lock, deadline, [this] { return interrupted_ || mailbox_.size() >= awaited_; });
  out->swap(mailbox_);
}

void RegionLinks::Interrupt() {
  {
    const std::lock_guard lock(mutex_);
    interrupted_ = true;
  }
  arrived_.notify_all();
}

void RegionLinks::Cut(RegionId peer) {
  const std::lock_guard lock(links_mutex_);
  if (const auto found = links_.find(peer); found != links_.end()) found->second.link->Cut();
}

void RegionLinks::CutAll() {
  const std::lock_guard lock(links_mutex_);
  for (auto& [peer, made] : links_) made.link->Cut();
}

bool RegionLinks::Drain(std::chrono::milliseconds at_most) {
  const auto deadline = Clock::now() + at_most;
  const std::lock_guard lock(links_mutex_);
  bool all = true;
  for (auto& [peer, made] : links_) {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(deadline - Clock::now());
    all &= made.link->AwaitWritten(std::max(left, std::chrono::milliseconds(0)));
  }
  return all;
}

void RegionLinks::Close() {
  const std::lock_guard lock(links_mutex_);
  if (service_ != nullptr) service_->Stop();
  for (auto& [peer, made] : links_) made.link->Close();
}

LinkStats RegionLinks::Totals() const {
  const std::lock_guard lock(links_mutex_);
  LinkStats sum = gone_;
  for (const auto& [peer, made] : links_) Add(made.link->stats(), &sum);
  return sum;
}

}  // namespace aureole
