// Certificates, tokens and servers for tests of who may call what.
#pragma once

#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "aureole/v1/control.grpc.pb.h"
#include "aureole/v1/error.pb.h"
#include "server/control/certificates.h"
#include "server/control/control_plane_service.h"
#include "server/control/control_service.h"
#include "server/control/issue_token.h"
#include "server/control/write_file.h"
#include "server/region/copy_keeper.h"
#include "server/transport/link_limits.h"
#include "server/transport/peer_link.h"
#include "server/transport/peer_service.h"
#include "server/transport/recording_service.h"
#include "server/transport/security.h"
#include "server/transport/simulation_service.h"

namespace aureole {

inline Validity Now() { return {absl::Now() - absl::Hours(1), absl::Now() + absl::Hours(1)}; }
inline Validity Over() { return {absl::Now() - absl::Hours(2), absl::Now() - absl::Hours(1)}; }

template <class T>
T Must(absl::StatusOr<T> value) {
  EXPECT_TRUE(value.ok()) << value.status();
  return *std::move(value);
}

inline std::string TextOf(const std::filesystem::path& path) {
  std::ostringstream text;
  text << std::ifstream(path).rdbuf();
  return text.str();
}

// A directory of its own for each test, with an authority.
class SecurityTest : public testing::Test {
 protected:
  SecurityTest() {
    std::string name = (std::filesystem::temp_directory_path() / "aureole-security-XXXXXX").string();
    directory_ = mkdtemp(name.data());
    authority_ = Must(MakeAuthority("ours", Now()));
  }
  ~SecurityTest() override { std::filesystem::remove_all(directory_); }

  // A directory for --tls with a certificate of this validity and these names, signed by `signer`; it trusts `trusted`.
  std::string Certificates(const std::string& name, const KeyedCertificate& signer, const KeyedCertificate& trusted,
                           const Validity& validity, const std::vector<std::string>& names = {kServerName}) {
    const std::filesystem::path out = directory_ / name;
    std::filesystem::create_directories(out);
    const KeyedCertificate certificate = Must(MakeCertificate(signer, name, names, validity));
    EXPECT_TRUE(WriteFile(out / "tls.key", certificate.key, 0600).ok());
    EXPECT_TRUE(WriteFile(out / "tls.crt", certificate.certificate, 0644).ok());
    EXPECT_TRUE(WriteFile(out / "ca.crt", trusted.certificate, 0644).ok());
    return out.string();
  }
  std::string Certificates(const std::string& name) { return Certificates(name, authority_, authority_, Now()); }

  std::string TokenPath() const { return (directory_ / "tokens.json").string(); }
  std::string Token(const std::vector<std::string>& rights, const std::string& world = "here",
                    std::optional<absl::Duration> life = std::nullopt) {
    return Must(IssueToken(TokenPath(), {"test", world, rights, life}));
  }

  std::filesystem::path directory_;
  KeyedCertificate authority_;
};

inline std::unique_ptr<Security> Open(const std::string& tls, const std::string& tokens = "") {
  SecurityOptions options;
  options.tls = tls;
  options.tokens = tokens;
  return Must(Security::Open(options));
}

// All services behind one guard, as region 1 of 2, without a world: a call that is admitted is UNAVAILABLE, NO_REGION.
// Only the operators' calls are answered, of a world that is not there either.
class GuardedServer {
 public:
  explicit GuardedServer(std::unique_ptr<Security> security, const std::string& world = "here")
      : security_(std::move(security)), control_(RunPlan{}), link_({Identity(1), 0, Deliver(), Log(), false, {}}) {
    security_->guard().ServeWorld(world);
    grpc::EnableDefaultHealthCheckService(true);
    grpc::ServerBuilder builder;
    ConfigureServer(&builder);
    security_->Listen(&builder, "127.0.0.1:0", &port_);
    Guard& guard = security_->guard();
    guard.Register(&builder, v1::Peer::service_full_name(), &peers_);
    guard.Register(&builder, v1::Simulation::service_full_name(), &simulation_);
    guard.Register(&builder, v1::Recording::service_full_name(), &recording_);
    guard.Register(&builder, v1::Copies::service_full_name(), &copies_);
    guard.Register(&builder, v1::Control::service_full_name(), &control_);
    guard.Register(&builder, v1::ControlPlane::service_full_name(), &operators_);
    server_ = builder.BuildAndStart();
    peers_.Serve(Identity(1), {&link_});
  }
  ~GuardedServer() {
    peers_.Stop();
    link_.Close();
    server_->Shutdown(std::chrono::system_clock::now() + std::chrono::seconds(1));
  }

  static LinkIdentity Identity(RegionId self) { return {kPeerProtocolVersion, 0xABCDEF, 3, self, 1, 0, 16000}; }

  std::string endpoint() const { return "127.0.0.1:" + std::to_string(port_); }
  PeerLink& link() { return link_; }
  // Waits until the link has got a frame; false after 30 s.
  bool AwaitFrame() {
    std::unique_lock lock(mutex_);
    return changed_.wait_for(lock, std::chrono::seconds(30), [&] { return frames_ > 0; });
  }

 private:
  std::function<void(Frame)> Deliver() {
    return [this](const Frame&) {
      const std::lock_guard lock(mutex_);
      ++frames_;
      changed_.notify_all();
    };
  }
  static std::function<void(RegionId, const std::string&)> Log() {
    return [](RegionId, const std::string&) {};
  }

  std::mutex mutex_;
  std::condition_variable changed_;
  int frames_ = 0;
  std::unique_ptr<Security> security_;
  PeerService peers_;
  SimulationService simulation_;
  RecordingService recording_;
  CopyKeeper copies_{""};
  ControlService control_;
  const World world_{*Layout::Columns({})};
  LayoutDesk desk_{world_};
  EventLog events_;
  CheckpointDesk checkpoints_{0, 16000};
  ControlPlaneService operators_{desk_, events_, checkpoints_, [] { return RunStatus(); }};
  PeerLink link_;
  int port_ = 0;
  std::unique_ptr<grpc::Server> server_;
};

}  // namespace aureole
