#include "tests/simulation/network.h"

#include "server/core/check.h"

namespace aureole::sim {

Network::Network(int regions, uint64_t seed, const Faults& faults) : faults_(faults), rng_(seed ^ 0x5eed) {
  for (RegionId a = 0; a < regions; ++a) {
    for (RegionId b = 0; b < regions; ++b) {
      if (a != b) AddLink(a, b);
    }
    regions_.insert(a);
  }
}

void Network::AddLink(RegionId from, RegionId to) {
  Link& link = links_[{from, to}];
  link.base_us = faults_.delay ? static_cast<int64_t>(rng_.In(100, 20000)) : 100;
  link.connection = ++links_made_ << 32;  // what was sent to a region of the same name before is not for this one
}

void Network::Add(RegionId region) {
  for (RegionId other : regions_) {
    AddLink(region, other);
    AddLink(other, region);
  }
  regions_.insert(region);
}

void Network::Remove(RegionId region) {
  regions_.erase(region);
  down_.erase(region);
  std::erase_if(links_, [region](const auto& l) { return l.first.first == region || l.first.second == region; });
}

void Network::Push(Event e) {
  e.order = ++order_;
  events_.push(std::move(e));
}

void Network::Send(RegionId from, RegionId to, std::shared_ptr<const Frame> frame) {
  Link& link = links_.at({from, to});
  const uint64_t sequence = link.sender.Push(frame);
  Transmit(from, to, sequence, frame);
  if (faults_.duplicates && rng_.Chance(0.03)) {
    ++duplicates_;
    Transmit(from, to, sequence, frame);
  }
  if (faults_.reconnects && rng_.Chance(0.01)) {
    ++reconnects_;
    Reconnect(from, to);
  }
}

void Network::Reconnect(RegionId from, RegionId to) {
  const uint64_t connection = ++links_.at({from, to}).connection;
  Push({now_us_ + static_cast<int64_t>(rng_.In(0, 50000)), 0, Event::Kind::kReconnect, from, to, connection, 0,
        nullptr});
}

void Network::Down(RegionId region) {
  down_.insert(region);
  for (auto& [ends, link] : links_) {
    if (ends.first == region || ends.second == region) ++link.connection;
  }
}

Network::Senders Network::SendersOf(RegionId region) const {
  Senders out;
  for (const auto& [ends, link] : links_) {
    if (ends.first == region) out[ends.second] = link.sender;
  }
  return out;
}

void Network::Up(RegionId region, const Senders& senders, const std::map<RegionId, uint64_t>& taken) {
  down_.erase(region);
  for (RegionId peer : regions_) {
    if (peer == region) continue;
    const auto sender = senders.find(peer);
    links_.at({region, peer}).sender = sender == senders.end() ? decltype(Link::sender)() : sender->second;
    Link& back = links_.at({peer, region});
    const auto frames = taken.find(peer);
    back.receiver = LinkReceiver(frames == taken.end() ? back.sender.first() - 1 : frames->second);
    Reconnect(region, peer);
    Reconnect(peer, region);
  }
}

void Network::Durable(RegionId region, const std::map<RegionId, uint64_t>& taken) {
  for (const auto& [peer, frames] : taken) {
    if (const auto link = links_.find({peer, region}); link != links_.end()) link->second.sender.Acknowledge(frames);
  }
}

void Network::Transmit(RegionId from, RegionId to, uint64_t sequence, const std::shared_ptr<const Frame>& frame) {
  Link& link = links_.at({from, to});
  int64_t at = now_us_ + link.base_us;
  if (faults_.jitter) at += static_cast<int64_t>(rng_.In(0, rng_.Chance(0.05) ? 60000 : 3000));
  // A connection keeps its order.
  link.last_arrival_us = at = std::max(at, link.last_arrival_us);
  Push({at, 0, Event::Kind::kFrame, from, to, link.connection, sequence, frame});
}

bool Network::CaughtUp(RegionId region) const {
  for (auto it = links_.lower_bound({region, 0}); it != links_.end() && it->first.first == region; ++it) {
    const Link& link = it->second;
    if (down_.contains(it->first.second) || link.receiver.applied() >= link.sender.next()) return false;
  }
  return true;
}

void Network::Wake(RegionId region, int64_t delay_us) {
  Push({now_us_ + delay_us, 0, Event::Kind::kWake, region, region, 0, 0, nullptr});
}

bool Network::RunNext(const std::function<void(RegionId, const Frame&)>& deliver,
                      const std::function<void(RegionId)>& wake) {
  if (events_.empty()) return false;
  const Event e = events_.top();
  events_.pop();
  now_us_ = e.at_us;
  if (e.kind == Event::Kind::kWake) {
    wake(e.to);
    return true;
  }
  const auto found = links_.find({e.from, e.to});
  if (found == links_.end()) return true;
  Link& link = found->second;
  if (e.connection != link.connection || down_.contains(e.to) || down_.contains(e.from)) return true;  // lost
  if (e.kind == Event::Kind::kReconnect) {
    link.last_arrival_us = now_us_;
    AUREOLE_CHECK(link.sender.first() <= link.receiver.applied() + 1, "region %d no longer has what region %d needs",
                  e.from, e.to);
    link.sender.Resume(link.receiver.applied(), [&](uint64_t sequence, const std::shared_ptr<const Frame>& frame) {
      Transmit(e.from, e.to, sequence, frame);
    });
    return true;
  }
  switch (link.receiver.Check(e.sequence)) {
    case LinkReceiver::Verdict::kApply:
      deliver(e.to, *e.frame);
      // The acknowledgement may take its time: what is kept too long does no harm.
      if (rng_.Chance(0.5) && !faults_.crashes) link.sender.Acknowledge(link.receiver.applied());
      break;
    case LinkReceiver::Verdict::kDuplicate:
      break;
    case LinkReceiver::Verdict::kGap:
      // Frames sent between the cut and the reconnect went into the new connection before its resume.
      break;
  }
  return true;
}

}  // namespace aureole::sim
