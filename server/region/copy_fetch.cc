#include "server/region/copy_fetch.h"

#include <thread>

#include <absl/strings/str_cat.h>
#include <grpcpp/client_context.h>

#include "server/transport/peer_channel.h"

namespace aureole {
namespace {

constexpr std::chrono::milliseconds kAskAgainAfter{100};

absl::StatusOr<Journal::Recovered> FetchOnce(v1::Copies::Stub* stub, const v1::CopyOf& of,
                                             std::chrono::system_clock::time_point deadline) {
  grpc::ClientContext context;
  context.set_deadline(deadline);
  const auto reader = stub->Fetch(&context, of);
  std::string checkpoint, inputs;
  v1::CopyPart part;
  while (reader->Read(&part)) {
    if (part.has_checkpoint()) checkpoint += part.checkpoint();
    if (part.has_inputs()) inputs += part.inputs();
  }
  if (const grpc::Status s = reader->Finish(); !s.ok()) {
    return absl::Status(static_cast<absl::StatusCode>(s.error_code()), s.error_message());
  }
  absl::StatusOr<Checkpoint> decoded = DecodeCheckpoint(checkpoint);
  if (!decoded.ok()) return decoded.status();
  absl::StatusOr<std::vector<LoggedInput>> logged = DecodeInputs(inputs);
  if (!logged.ok()) return logged.status();
  return Journal::Recovered{*std::move(decoded), *std::move(logged)};
}

}  // namespace

absl::StatusOr<Journal::Recovered> FetchCopy(const CopyIdentity& identity, RegionId keeper, const std::string& endpoint,
                                             const std::shared_ptr<grpc::ChannelCredentials>& credentials,
                                             std::chrono::milliseconds at_most) {
  const auto deadline = std::chrono::system_clock::now() + at_most;
  const auto stub = v1::Copies::NewStub(PeerChannel(endpoint, credentials));
  const v1::CopyOf of = CopyOfMessage(identity, keeper);
  for (;;) {
    absl::StatusOr<Journal::Recovered> out = FetchOnce(stub.get(), of, deadline);
    const bool over = std::chrono::system_clock::now() + kAskAgainAfter >= deadline;
    if (out.ok() || !absl::IsUnavailable(out.status()) || over) return out;
    std::this_thread::sleep_for(kAskAgainAfter);
  }
}

}  // namespace aureole
