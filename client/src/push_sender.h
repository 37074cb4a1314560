// Sends pushes so that each acts once: in order, over one stream at a time, all that are not settled again after a lost
// connection, or from a server that has left, to the next server.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <grpcpp/client_context.h>

#include "aureole/client.h"
#include "aureole/v1/simulation.grpc.pb.h"

namespace aureole::client {

class PushSender {
 public:
  PushSender(std::vector<std::string> endpoints, uint64_t client, Access access = {});
  ~PushSender();

  // From here on these are the servers, at least one. A stream to another one is given up.
  void Follow(std::vector<std::string> endpoints);
  void Send(const Push& push);
  // False after the timeout.
  bool Flush(double timeout_seconds);
  PushCounts counts() const;
  // Cuts the connection, as a network may. For tests.
  void Cut();

 private:
  struct Pending {
    uint64_t sequence = 0;
    Push push;
  };
  // What each message of the stream held, to find what a refusal is about.
  using Sent = std::vector<std::vector<uint64_t>>;

  void Run();
  void Serve(const std::string& endpoint);
  void ReadOutcomes(grpc::ClientReaderWriter<v1::PlayRequest, v1::PlayResponse>* stream);
  void Settle(const v1::InputOutcomes& outcomes);
  void Refuse(const Sent& sent, const grpc::Status& status);
  void Reject(uint64_t sequence, const std::string& reason);

  const uint64_t client_;
  const Access access_;

  mutable std::mutex mutex_;
  std::vector<std::string> endpoints_;
  std::string serving_;  // where context_'s stream goes
  std::condition_variable changed_;
  std::deque<Pending> pending_;  // not settled; ascending
  size_t unsent_ = 0;            // how many of the last of these were not sent on this stream
  uint64_t last_sequence_ = 0;
  PushCounts counts_;
  std::map<std::string, int64_t> reasons_;
  std::shared_ptr<grpc::ClientContext> context_;  // of the stream; null: none
  bool stream_ended_ = false, ended_ = false;

  std::thread thread_;
};

}  // namespace aureole::client
