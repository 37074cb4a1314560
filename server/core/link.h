// Sequencing of one direction of a link: exactly once, in order, over any number of connections (P54). The sender
// numbers messages from 1 and keeps them until they are acknowledged as durable; a new connection goes on after the
// last one that the receiver applied.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <utility>
#include <vector>

namespace aureole {

// `Message` is cheap to copy (a shared pointer, say). Not thread-safe.
template <class Message>
class LinkSender {
 public:
  LinkSender() = default;
  // Goes on where another stopped: it keeps `kept`, the first of which has number `first`.
  LinkSender(uint64_t first, std::deque<Message> kept) : first_(first), kept_(std::move(kept)) {}

  // Keeps the message and returns its number.
  uint64_t Push(Message m) {
    kept_.push_back(std::move(m));
    return first_ + kept_.size() - 1;
  }
  // The receiver needs nothing up to `sequence` again. Numbers already acknowledged, or never sent, are ignored.
  void Acknowledge(uint64_t sequence) {
    while (first_ <= sequence && !kept_.empty()) {
      kept_.pop_front();
      ++first_;
    }
  }
  // Whether a receiver that has applied everything up to `last_applied` can be served.
  bool CanResume(uint64_t last_applied) const { return last_applied + 1 >= first_ && last_applied < next(); }
  // Calls fn(sequence, message) for everything after `last_applied`, in order. Precondition: CanResume.
  template <class Fn>
  void Resume(uint64_t last_applied, Fn&& fn) const {
    for (uint64_t s = last_applied + 1; s < next(); ++s) fn(s, kept_[s - first_]);
  }
  // Number of the oldest that is kept, and of the next one.
  uint64_t first() const { return first_; }
  uint64_t next() const { return first_ + kept_.size(); }
  size_t kept() const { return kept_.size(); }
  const std::deque<Message>& messages() const { return kept_; }

 private:
  uint64_t first_ = 1;  // number of kept_.front()
  std::deque<Message> kept_;
};

class LinkReceiver {
 public:
  LinkReceiver() = default;
  // Goes on where another stopped.
  explicit LinkReceiver(uint64_t applied) : applied_(applied) {}

  enum class Verdict { kApply, kDuplicate, kGap };
  // kApply: the next one, and it is now counted as applied. kGap: something is missing; the connection must resume.
  Verdict Check(uint64_t sequence) {
    if (sequence <= applied_) return Verdict::kDuplicate;
    if (sequence != applied_ + 1) return Verdict::kGap;
    applied_ = sequence;
    return Verdict::kApply;
  }
  uint64_t applied() const { return applied_; }

 private:
  uint64_t applied_ = 0;
};

}  // namespace aureole
