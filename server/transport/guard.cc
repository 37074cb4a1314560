#include "server/transport/guard.h"

#include <fstream>
#include <optional>
#include <sstream>
#include <utility>

#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/time/clock.h>
#include <google/protobuf/descriptor.h>
#include <grpc/byte_buffer.h>
#include <grpc/grpc_security_constants.h>
#include <grpcpp/impl/codegen/server_callback_handlers.h>
#include <grpcpp/impl/rpc_service_method.h>
#include <grpcpp/impl/service_type.h>
#include <grpcpp/security/auth_context.h>
#include <grpcpp/support/byte_buffer.h>
#include <grpcpp/support/server_callback.h>

#include "server/core/check.h"
#include "server/transport/error_status.h"
#include "server/transport/server_certificate.h"

namespace aureole {
namespace {

using grpc::internal::MethodHandler;
using grpc::internal::RpcMethod;

constexpr char kScheme[] = "Bearer ";

// Of the call whose handler this thread is in; null: none, or without a guard.
thread_local const Rights* rights_of_caller = nullptr;

// Ends a call of any kind, with a status only.
class Refused final : public grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer> {
 public:
  explicit Refused(const grpc::Status& status) { Finish(status); }
  void OnDone() override { delete this; }
};

std::vector<std::string> TokensOf(const grpc::ServerContextBase& context) {
  std::vector<std::string> out;
  const auto [first, last] = context.client_metadata().equal_range("authorization");
  for (auto it = first; it != last; ++it) {
    const std::string value(it->second.data(), it->second.size());
    out.push_back(absl::StartsWithIgnoreCase(value, kScheme) ? value.substr(sizeof kScheme - 1) : "");
  }
  return out;
}

// What the caller has shown, PEM; empty: nothing. The handshake has proved that he holds the key, and no more.
std::string CertificatesOf(const grpc::ServerContextBase& context) {
  const std::shared_ptr<const grpc::AuthContext> peer = context.auth_context();
  std::string out;
  if (peer == nullptr) return out;
  const auto own = peer->FindPropertyValues(GRPC_X509_PEM_CERT_PROPERTY_NAME);
  if (own.size() != 1) return out;  // the first must be the one whose key he holds
  out.assign(own[0].data(), own[0].size());
  for (const grpc::string_ref& further : peer->FindPropertyValues(GRPC_X509_PEM_CERT_CHAIN_PROPERTY_NAME)) {
    out.append(further.data(), further.size());
  }
  return out;
}

std::string TextOf(const std::string& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

// Before the handler of one method.
class Door final : public MethodHandler {
 public:
  Door(Guard* guard, const Access& access, bool one_request, MethodHandler* inner)
      : guard_(guard), access_(access), one_request_(one_request), inner_(inner) {}

  // Kept as it is until the caller is known.
  void* Deserialize(grpc_call*, grpc_byte_buffer* request, grpc::Status*, void** kept) override {
    *kept = request;
    return nullptr;
  }

  void RunHandler(const HandlerParameter& call) override {
    auto* const bytes = static_cast<grpc_byte_buffer*>(call.internal_data);
    Rights rights = Rights::All();
    const grpc::Status verdict = guard_->Admit(access_, *call.server_context, &rights);
    if (!verdict.ok()) {
      if (bytes != nullptr) grpc_byte_buffer_destroy(bytes);
      grpc::internal::CallbackBidiHandler<grpc::ByteBuffer, grpc::ByteBuffer> refuse(
          [&](grpc::CallbackServerContext*) { return new Refused(verdict); });
      refuse.RunHandler({call.call, call.server_context, nullptr, grpc::Status::OK, nullptr, call.call_requester});
      return;
    }
    grpc::Status status = call.status;
    void *request = nullptr, *data = nullptr;
    if (one_request_) request = inner_->Deserialize(call.call->call(), bytes, &status, &data);
    rights_of_caller = &rights;
    inner_->RunHandler({call.call, call.server_context, request, status, data, call.call_requester});
    rights_of_caller = nullptr;
  }

 private:
  Guard* const guard_;
  const Access access_;
  const bool one_request_;  // comes with the call
  MethodHandler* const inner_;
};

RpcMethod::RpcType TypeOf(const google::protobuf::MethodDescriptor& method) {
  if (method.client_streaming()) {
    return method.server_streaming() ? RpcMethod::BIDI_STREAMING : RpcMethod::CLIENT_STREAMING;
  }
  return method.server_streaming() ? RpcMethod::SERVER_STREAMING : RpcMethod::NORMAL_RPC;
}

}  // namespace

// The methods of another service, which it must outlive, each behind a door.
class Guard::Service final : public grpc::Service {
 public:
  Service(Guard* guard, const google::protobuf::ServiceDescriptor& descriptor, grpc::Service* inner) {
    names_.reserve(static_cast<size_t>(descriptor.method_count()));
    for (int i = 0; i < descriptor.method_count(); ++i) {
      const google::protobuf::MethodDescriptor& method = *descriptor.method(i);
      const auto access = MethodAccess().find(method.full_name());
      AUREOLE_CHECK(access != MethodAccess().end(), "%s has no place in MethodAccess", method.full_name().c_str());
      MethodHandler* const handler = (inner->*(&Service::GetHandler))(i);
      AUREOLE_CHECK(handler != nullptr, "%s has no handler", method.full_name().c_str());
      names_.push_back(absl::StrCat("/", descriptor.full_name(), "/", method.name()));
      auto* const door = new Door(guard, access->second, !method.client_streaming(), handler);
      auto* const out = new grpc::internal::RpcServiceMethod(names_.back().c_str(), TypeOf(method), door);
      out->SetServerApiType(grpc::internal::RpcServiceMethod::ApiType::CALL_BACK);
      AddMethod(out);
    }
  }

 private:
  std::vector<std::string> names_;  // gRPC keeps pointers to them
};

const std::map<std::string, Access>& MethodAccess() {
  constexpr Access kServers{true, v1::Token::UNKNOWN};
  constexpr Access kWatch{false, v1::Token::WATCH}, kPush{false, v1::Token::PUSH};
  constexpr Access kSpawn{false, v1::Token::SPAWN}, kOperate{false, v1::Token::OPERATE};
  static const std::map<std::string, Access> table = {
      {"aureole.v1.Peer.Link", kServers},
      {"aureole.v1.Copies.Keep", kServers},
      {"aureole.v1.Copies.Fetch", kServers},
      {"aureole.v1.Control.Join", kServers},
      {"aureole.v1.Simulation.GetWorld", kWatch},
      {"aureole.v1.Simulation.StreamReplicas", kWatch},
      {"aureole.v1.Simulation.Play", kWatch},  // inputs need PUSH too
      {"aureole.v1.Simulation.CastRays", kWatch},
      {"aureole.v1.Simulation.WatchLayout", kWatch},
      {"aureole.v1.Simulation.ApplyImpulses", kPush},
      {"aureole.v1.Simulation.SpawnBodies", kSpawn},
      {"aureole.v1.Simulation.RemoveBodies", kSpawn},
      {"aureole.v1.Recording.Record", kOperate},
      {"aureole.v1.ControlPlane.GetWorld", kWatch},
      {"aureole.v1.ControlPlane.WatchEvents", kOperate},  // they name files and machines
      {"aureole.v1.ControlPlane.ResizeLayout", kOperate},
      {"aureole.v1.ControlPlane.DrainRegion", kOperate},
      {"aureole.v1.ControlPlane.SaveCheckpoint", kOperate},
  };
  return table;
}

Rights::Rights(const v1::Token& token) {
  for (int right : token.rights()) bits_ |= 1u << right;
}

Rights RightsOfCaller() { return rights_of_caller == nullptr ? Rights::All() : *rights_of_caller; }

grpc::Status NoRight(const std::string& field, v1::Token::Right right) {
  return Refusal(grpc::StatusCode::PERMISSION_DENIED, v1::NO_RIGHT, field,
                 absl::StrCat("needs the right ", v1::Token::Right_Name(right),
                              ", which the token does not give; ask for a token with it"));
}

Guard::Guard(std::string authorities, std::unique_ptr<TokenFile> tokens)
    : authorities_(std::move(authorities)), tokens_(std::move(tokens)) {}
Guard::~Guard() = default;

void Guard::Register(grpc::ServerBuilder* builder, const char* full_name, grpc::Service* service) {
  const auto* descriptor = google::protobuf::DescriptorPool::generated_pool()->FindServiceByName(full_name);
  AUREOLE_CHECK(descriptor != nullptr, "%s is no service", full_name);
  services_.push_back(std::make_unique<Service>(this, *descriptor, service));
  builder->RegisterService(services_.back().get());
}

void Guard::ServeWorld(const std::string& world) {
  ServeWorlds([world](const grpc::ServerContextBase&, const std::string&, std::string* out) {
    *out = world;
    return grpc::Status::OK;
  });
}

void Guard::ServeWorlds(WorldOf world_of) {
  const std::lock_guard lock(mutex_);
  world_of_ = std::move(world_of);
}

grpc::Status Guard::Admit(const Access& access, const grpc::ServerContextBase& context, Rights* rights) {
  if (access.server) return AdmitServer(context);
  if (tokens_ == nullptr) return grpc::Status::OK;
  const std::vector<std::string> tokens = TokensOf(context);
  if (tokens.size() != 1 || tokens[0].empty()) {
    return Refusal(grpc::StatusCode::UNAUTHENTICATED, v1::NO_TOKEN, "authorization",
                   "must be in the metadata of every call, once, as \"Bearer TOKEN\"");
  }
  return AdmitToken(access.right, tokens[0], context, rights);
}

// Servers have no tokens: who says one is a client, even where servers have no certificates.
grpc::Status Guard::AdmitServer(const grpc::ServerContextBase& context) const {
  std::string why = "no token opens it";
  if (TokensOf(context).empty()) {
    if (authorities_.empty()) return grpc::Status::OK;
    const absl::Status shown = CheckServerCertificate(CertificatesOf(context), TextOf(authorities_));
    if (shown.ok()) return grpc::Status::OK;
    why = std::string(shown.message());
  }
  return Refusal(grpc::StatusCode::UNAUTHENTICATED, v1::NOT_A_SERVER, "",
                 absl::StrCat("only servers may call this, by a certificate of this server's authority: ", why));
}

grpc::Status Guard::AdmitToken(v1::Token::Right right, const std::string& token, const grpc::ServerContextBase& context,
                               Rights* rights) {
  const std::optional<v1::Token> entry = tokens_->Find(token);
  if (!entry.has_value()) {
    return Refusal(grpc::StatusCode::UNAUTHENTICATED, v1::TOKEN_UNKNOWN, "authorization",
                   "is not a token of this server; ask for another one");
  }
  if (entry->has_expires() && entry->expires().seconds() <= absl::ToUnixSeconds(absl::Now())) {
    return Refusal(grpc::StatusCode::UNAUTHENTICATED, v1::TOKEN_EXPIRED, "authorization",
                   "is over; ask for another token");
  }
  WorldOf world_of;
  {
    const std::lock_guard lock(mutex_);
    world_of = world_of_;
  }
  if (world_of == nullptr) return NoRegion();
  std::string world;
  if (grpc::Status s = world_of(context, entry->world(), &world); !s.ok()) return s;
  if (entry->world() != world) {
    return Refusal(
        grpc::StatusCode::PERMISSION_DENIED, v1::WRONG_WORLD, "authorization",
        absl::StrCat("is for the world ", entry->world(), ", this is ", world, "; use a token of this world"));
  }
  *rights = Rights(*entry);
  return rights->Has(right) ? grpc::Status::OK : NoRight("", right);
}

}  // namespace aureole
