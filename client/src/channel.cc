#include "client/src/channel.h"

#include <utility>
#include <vector>

#include <grpcpp/create_channel.h>
#include <grpcpp/security/credentials.h>
#include <grpcpp/support/client_interceptor.h>

namespace aureole::client {
namespace {

// The DNS name in the certificates of servers, wherever they run.
constexpr char kServerName[] = "server.aureole";

class TokenSayer final : public grpc::experimental::Interceptor {
 public:
  explicit TokenSayer(std::string value) : value_(std::move(value)) {}
  void Intercept(grpc::experimental::InterceptorBatchMethods* methods) override {
    if (methods->QueryInterceptionHookPoint(grpc::experimental::InterceptionHookPoints::PRE_SEND_INITIAL_METADATA)) {
      methods->GetSendInitialMetadata()->emplace("authorization", value_);
    }
    methods->Proceed();
  }

 private:
  const std::string value_;
};

class TokenSayers final : public grpc::experimental::ClientInterceptorFactoryInterface {
 public:
  explicit TokenSayers(const std::string& token) : value_("Bearer " + token) {}
  grpc::experimental::Interceptor* CreateClientInterceptor(grpc::experimental::ClientRpcInfo*) override {
    return new TokenSayer(value_);
  }

 private:
  const std::string value_;
};

bool OfThisMachine(const std::string& endpoint) {
  const std::string host = endpoint.substr(0, endpoint.rfind(':'));
  return host == "localhost" || host == "[::1]" || host == "127.0.0.1" || endpoint.rfind("unix:", 0) == 0;
}

}  // namespace

std::shared_ptr<grpc::Channel> ChannelTo(const std::string& endpoint, const Access& access,
                                         grpc::ChannelArguments arguments) {
  const bool tls = !access.tls_ca.empty();
  if (tls) arguments.SetSslTargetNameOverride(kServerName);
  const auto credentials = tls ? grpc::SslCredentials({access.tls_ca, "", ""}) : grpc::InsecureChannelCredentials();
  if (access.token.empty() || !(tls || OfThisMachine(endpoint))) {
    return grpc::CreateCustomChannel(endpoint, credentials, arguments);
  }
  std::vector<std::unique_ptr<grpc::experimental::ClientInterceptorFactoryInterface>> sayers;
  sayers.push_back(std::make_unique<TokenSayers>(access.token));
  return grpc::experimental::CreateCustomChannelWithInterceptors(endpoint, credentials, arguments, std::move(sayers));
}

}  // namespace aureole::client
