#include "server/region/region_links.h"

#include <algorithm>

#include "server/transport/frame_codec.h"

namespace aureole {

RegionLinks::RegionLinks(const LinkIdentity& identity, const std::vector<RegionId>& peers,
                         std::function<void(RegionId, const std::string&)> log, bool keep,
                         std::map<RegionId, LinkState> states)
    : identity_(identity) {
  const auto deliver = [this](Frame frame) {
    bool enough = false;
    {
      const std::lock_guard lock(mutex_);
      mailbox_.push_back(std::move(frame));
      enough = mailbox_.size() >= awaited_;
    }
    if (enough) arrived_.notify_one();
  };
  for (RegionId peer : peers)
    links_.push_back(
        std::make_unique<PeerLink>(PeerLink::Options{identity, peer, deliver, log, keep, std::move(states[peer])}));
}

RegionLinks::~RegionLinks() { Close(); }

void RegionLinks::Connect(PeerService* service, const std::vector<std::string>& endpoints,
                          const std::shared_ptr<grpc::ChannelCredentials>& credentials) {
  service_ = service;
  std::vector<PeerLink*> dialled_by_peer;
  for (const auto& link : links_) {
    if (link->peer() < identity_.self) dialled_by_peer.push_back(link.get());
  }
  service->Serve(identity_, dialled_by_peer);
  for (const auto& link : links_) {
    if (link->peer() > identity_.self) link->Dial(endpoints.at(link->peer()), credentials);
  }
}

void RegionLinks::Redirect(RegionId peer, const std::string& endpoint, uint64_t incarnation) {
  for (const auto& link : links_) {
    if (link->peer() == peer) link->Redirect(endpoint, incarnation);
  }
}

void RegionLinks::SetDurable(const std::map<RegionId, uint64_t>& frames) {
  for (const auto& link : links_) link->SetDurable(frames.at(link->peer()));
}

std::map<RegionId, LinkState> RegionLinks::States() const {
  std::map<RegionId, LinkState> out;
  for (const auto& link : links_) out[link->peer()] = link->State();
  return out;
}

Tick RegionLinks::log_until() const {
  Tick out = identity_.log_until;
  for (const auto& link : links_) out = std::max(out, link->log_until());
  return out;
}

bool RegionLinks::caught_up() const {
  return std::all_of(links_.begin(), links_.end(), [](const auto& link) { return link->caught_up(); });
}

void RegionLinks::Send(const std::vector<Frame>& frames) {
  for (const Frame& frame : frames) {
    const auto bytes = std::make_shared<const std::string>(EncodeFrame(frame));
    for (const auto& link : links_) {
      if (std::binary_search(frame.to.begin(), frame.to.end(), link->peer())) link->Send(bytes);
    }
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
  for (const auto& link : links_) {
    if (link->peer() == peer) link->Cut();
  }
}

void RegionLinks::CutAll() {
  for (const auto& link : links_) link->Cut();
}

bool RegionLinks::Drain(std::chrono::milliseconds at_most) {
  const auto deadline = Clock::now() + at_most;
  bool all = true;
  for (const auto& link : links_) {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(deadline - Clock::now());
    all &= link->AwaitWritten(std::max(left, std::chrono::milliseconds(0)));
  }
  return all;
}

void RegionLinks::Close() {
  if (service_ != nullptr) service_->Stop();
  for (const auto& link : links_) link->Close();
}

LinkStats RegionLinks::Totals() const {
  LinkStats sum;
  for (const auto& link : links_) {
    const LinkStats s = link->stats();
    sum.frames_sent += s.frames_sent;
    sum.frames_received += s.frames_received;
    sum.frames_kept += s.frames_kept;
    sum.bytes_sent += s.bytes_sent;
    sum.connections += s.connections;
    sum.reconnects += s.reconnects;
    sum.refused_hellos += s.refused_hellos;
    sum.refused_frames += s.refused_frames;
    sum.duplicates += s.duplicates;
  }
  return sum;
}

}  // namespace aureole
