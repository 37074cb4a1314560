// Who may call what: certificates and tokens over real sockets, each refusal with its reason, and files that change.
#include "tests/e2e/security_fixture.h"

#include <google/protobuf/descriptor.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/security/tls_certificate_provider.h>
#include <grpcpp/security/tls_credentials_options.h>

#include <set>
#include <thread>

#include "client/src/channel.h"
#include "server/control/control_hub.h"
#include "server/transport/frame_codec.h"

namespace aureole {
namespace {

using std::chrono::seconds;

// A connection of its own, made anew.
grpc::ChannelArguments Fresh() {
  grpc::ChannelArguments out;
  out.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  return out;
}

// Ends any call of our services: says nothing, and reads its status. Its reason, and what is wrong with the caller's
// certificate; gRPC's message when it has none.
std::string Call(const std::shared_ptr<grpc::Channel>& channel, const std::string& method,
                 const std::string& token = "") {
  grpc::GenericStub stub(channel);
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + seconds(20));
  if (!token.empty()) context.AddMetadata("authorization", "Bearer " + token);
  grpc::CompletionQueue queue;
  const auto next = [&queue] {
    void* tag = nullptr;
    bool ok = false;
    queue.Next(&tag, &ok);
    return ok;
  };
  const auto call = stub.PrepareCall(&context, method, &queue);
  call->StartCall(nullptr);
  if (next()) {
    grpc::Slice nothing;
    call->WriteLast(grpc::ByteBuffer(&nothing, 1), {}, nullptr);
    next();
    grpc::ByteBuffer answer;
    do call->Read(&answer, nullptr);
    while (next());
  }
  grpc::Status status;
  call->Finish(&status, nullptr);
  next();
  queue.Shutdown();
  v1::ErrorStatus details;
  v1::ErrorDetail detail;
  if (!details.ParseFromString(status.error_details()) || details.details_size() == 0 ||
      !details.details(0).UnpackTo(&detail)) {
    return status.ok() ? "OK" : status.error_message();
  }
  EXPECT_EQ(details.code(), status.error_code());
  EXPECT_GT(detail.remedy().size(), 10u);
  std::string out = v1::Reason_Name(detail.reason());
  if (detail.reason() == v1::NOT_A_SERVER) out += detail.remedy().substr(detail.remedy().rfind(": ") + 1);
  return out;
}

std::string PathOf(const std::string& full_name) {
  const size_t dot = full_name.rfind('.');
  return "/" + full_name.substr(0, dot) + "/" + full_name.substr(dot + 1);
}

constexpr char kLink[] = "/aureole.v1.Peer/Link";
constexpr char kJoin[] = "/aureole.v1.Control/Join";
constexpr char kKeep[] = "/aureole.v1.Copies/Keep", kFetch[] = "/aureole.v1.Copies/Fetch";
constexpr char kGetWorld[] = "/aureole.v1.Simulation/GetWorld";
constexpr char kAdmitted[] = "the first message is no hello";  // Link's handler has been reached

std::string CallAs(const Security& server, const std::string& endpoint, const std::string& method = kLink) {
  return Call(grpc::CreateCustomChannel(endpoint, server.channel(), Fresh()), method);
}

client::Access Trusting(const KeyedCertificate& authority, const std::string& token = "") {
  return {authority.certificate, token};
}

using GuardedCalls = SecurityTest;
using MutualTls = SecurityTest;
using Tokens = SecurityTest;
using Rotation = SecurityTest;

TEST_F(MutualTls, RegionsLinkWithCertificatesOfOneAuthority) {
  GuardedServer low(Open(Certificates("low"))), high(Open(Certificates("high")));
  const std::unique_ptr<Security> dialler = Open(Certificates("low"));
  std::mutex mutex;
  std::condition_variable changed;
  int frames = 0;
  PeerLink link({GuardedServer::Identity(0),
                 1,
                 [&](const Frame&) {
                   const std::lock_guard lock(mutex);
                   ++frames;
                   changed.notify_all();
                 },
                 [](RegionId, const std::string&) {},
                 false,
                 {}});
  link.Dial(high.endpoint(), dialler->channel());
  Frame frame;
  frame.tick = 1;
  const auto bytes = std::make_shared<const std::string>(EncodeFrame(frame));
  link.Send(bytes);
  high.link().Send(bytes);
  EXPECT_TRUE(high.AwaitFrame());
  std::unique_lock lock(mutex);
  EXPECT_TRUE(changed.wait_for(lock, seconds(30), [&] { return frames > 0; }));
}

TEST_F(MutualTls, WrongAuthorityIsRefusedByBothSides) {
  const KeyedCertificate other = Must(MakeAuthority("ours", Now()));  // by its name
  const GuardedServer server(Open(Certificates("server")));
  EXPECT_EQ(CallAs(*Open(Certificates("one")), server.endpoint()), kAdmitted);
  // The server refuses the caller's.
  const std::string caller = CallAs(*Open(Certificates("stranger", other, authority_, Now())), server.endpoint());
  EXPECT_EQ(caller, "NOT_A_SERVER unable to get local issuer certificate");
  // The caller refuses the server's.
  const std::string served = CallAs(*Open(Certificates("mistaken", authority_, other, Now())), server.endpoint());
  EXPECT_NE(served.find("certificate verify failed"), std::string::npos) << served;
  const std::string client = Call(client::ChannelTo(server.endpoint(), Trusting(other), Fresh()), kGetWorld);
  EXPECT_NE(client.find("certificate verify failed"), std::string::npos) << client;
}

TEST_F(MutualTls, ExpiredCertificateIsRefusedByBothSides) {
  const GuardedServer server(Open(Certificates("server")));
  const std::string caller = CallAs(*Open(Certificates("late", authority_, authority_, Over())), server.endpoint());
  EXPECT_EQ(caller, "NOT_A_SERVER certificate has expired");
  const GuardedServer late(Open(Certificates("late-server", authority_, authority_, Over())));
  const std::string served = CallAs(*Open(Certificates("caller")), late.endpoint());
  EXPECT_NE(served.find("certificate verify failed"), std::string::npos) << served;
}

TEST_F(MutualTls, CertificateOfAClientOpensNoServersMethod) {
  const GuardedServer server(Open(Certificates("server")));
  const auto client = Open(Certificates("client", authority_, authority_, Now(), {"player.aureole"}));
  for (const char* method : {kLink, kKeep, kFetch, kJoin}) {
    EXPECT_EQ(CallAs(*client, server.endpoint(), method), "NOT_A_SERVER it does not have the DNS name server.aureole");
    EXPECT_EQ(Call(client::ChannelTo(server.endpoint(), Trusting(authority_), Fresh()), method),
              "NOT_A_SERVER there is no certificate");
  }
}

TEST_F(MutualTls, ServerWithoutTheNameOfServersIsRefusedByCallers) {
  const GuardedServer server(
      Open(Certificates("server", authority_, authority_, Now(), {"player.aureole", "127.0.0.1"})));
  const std::string served = CallAs(*Open(Certificates("caller")), server.endpoint());
  EXPECT_NE(served.find("does not have the DNS name server.aureole"), std::string::npos) << served;
  const std::string client = Call(client::ChannelTo(server.endpoint(), Trusting(authority_), Fresh()), kGetWorld);
  EXPECT_EQ(client.find("NO_REGION"), std::string::npos) << client;
}

TEST_F(MutualTls, PlainTextIsRefused) {
  const GuardedServer server(Open(Certificates("server")));
  const std::string said = Call(client::ChannelTo(server.endpoint(), {}, Fresh()), kGetWorld);
  EXPECT_NE(said, "NO_REGION");
}

// What a method says to a caller: NO_REGION comes from its handler, which has been reached.
TEST_F(GuardedCalls, EveryMethodWantsItsRightAndNoOther) {
  using Right = v1::Token;
  std::map<Right::Right, std::string> tokens;
  for (Right::Right right : {Right::WATCH, Right::PUSH, Right::SPAWN, Right::OPERATE}) {
    tokens[right] = Token({v1::Token::Right_Name(right)});
  }
  const GuardedServer server(Open(Certificates("server"), TokenPath()));
  const auto channel = client::ChannelTo(server.endpoint(), Trusting(authority_), Fresh());
  for (const auto& [method, access] : MethodAccess()) {
    const std::string path = PathOf(method);
    EXPECT_EQ(Call(channel, path), access.server ? "NOT_A_SERVER there is no certificate" : "NO_TOKEN") << method;
    for (const auto& [right, token] : tokens) {
      const bool granted = right == access.right;
      const std::string said = Call(channel, path, token);
      if (granted && method.starts_with(v1::ControlPlane::service_full_name())) {
        EXPECT_TRUE(!said.empty() && !said.starts_with("NO_")) << method << " is answered by its handler: " << said;
        continue;
      }
      EXPECT_EQ(said, access.server ? "NOT_A_SERVER no token opens it"
                      : granted     ? "NO_REGION"
                                    : "NO_RIGHT")
          << method << " with " << v1::Token::Right_Name(right);
    }
  }
}

TEST_F(GuardedCalls, TokenOpensNoServersMethodInPlainTextEither) {
  const std::string token = Token({"watch", "push", "spawn", "operate"});
  const GuardedServer server(Open("", TokenPath()));
  const auto channel = client::ChannelTo(server.endpoint(), {"", token}, Fresh());
  EXPECT_EQ(Call(channel, kGetWorld), "NO_REGION");
  for (const char* method : {kLink, kKeep, kFetch, kJoin}) {
    EXPECT_EQ(Call(channel, method), "NOT_A_SERVER no token opens it") << method;
  }
}

TEST_F(GuardedCalls, ServersAreOpenToClientsWithoutAFileOfTokens) {
  const GuardedServer server(Open(""));
  EXPECT_EQ(Call(client::ChannelTo(server.endpoint(), {}, Fresh()), kGetWorld), "NO_REGION");
}

TEST_F(GuardedCalls, HealthIsOpen) {
  Token({"watch"});
  const GuardedServer server(Open(Certificates("server"), TokenPath()));
  EXPECT_EQ(Call(client::ChannelTo(server.endpoint(), Trusting(authority_), Fresh()), "/grpc.health.v1.Health/Check"),
            "OK");
}

TEST_F(Tokens, EachRefusalHasItsReason) {
  const std::string good = Token({"watch"});
  const std::string elsewhere = Token({"watch"}, "there"), over = Token({"watch"}, "here", -absl::Seconds(5));
  const GuardedServer server(Open(Certificates("server"), TokenPath()));
  const auto say = [&](const std::string& token) {
    return Call(client::ChannelTo(server.endpoint(), Trusting(authority_, token), Fresh()), kGetWorld);
  };
  EXPECT_EQ(say(good), "NO_REGION");
  EXPECT_EQ(say(""), "NO_TOKEN");
  EXPECT_EQ(say(good + "x"), "TOKEN_UNKNOWN");
  EXPECT_EQ(say(Sha256Hex(good)), "TOKEN_UNKNOWN");  // the file is no key
  EXPECT_EQ(say(elsewhere), "WRONG_WORLD");
  EXPECT_EQ(say(over), "TOKEN_EXPIRED");
}

TEST_F(Tokens, EachOfSeveralWorldsWantsItsOwn) {
  const std::string watch = Token({"watch"}, "one"), operate = Token({"watch", "operate"}, "two");
  World one{*Layout::Columns({})}, two{*Layout::Columns({})};
  one.name = "one";
  two.name = "two";
  LayoutDesk one_desk(one), two_desk(two);
  EventLog log;
  CheckpointDesk checkpoints(0, 16000);
  ControlPlaneService one_operators(one_desk, log, checkpoints, [] { return RunStatus(); });
  ControlPlaneService two_operators(two_desk, log, checkpoints, [] { return RunStatus(); });
  ControlService servers{RunPlan()};
  ControlHub hub;
  hub.Add("a", {&servers, &one_operators, "one"});
  hub.Add("b", {&servers, &two_operators, "two"});
  const std::unique_ptr<Security> security = Open(Certificates("server"), TokenPath());
  security->guard().ServeWorlds([&hub](const grpc::ServerContextBase& context, const std::string& known,
                                       std::string* world) { return hub.TokensFor(context, known, world); });
  grpc::ServerBuilder builder;
  int port = 0;
  security->Listen(&builder, "127.0.0.1:0", &port);
  security->guard().Register(&builder, v1::Control::service_full_name(), &hub);
  security->guard().Register(&builder, v1::ControlPlane::service_full_name(), &hub.operators());
  const std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  const std::string endpoint = "127.0.0.1:" + std::to_string(port);
  const auto channel = client::ChannelTo(endpoint, Trusting(authority_), Fresh());
  const auto say = [&](const std::string& method, const std::string& token, const std::string& world) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + seconds(20));
    context.AddMetadata("authorization", "Bearer " + token);
    if (!world.empty()) context.AddMetadata(kWorldMetadata, world);
    const auto stub = v1::ControlPlane::NewStub(channel);
    v1::ControlledWorld answer;
    v1::DrainRegionResponse drained;
    const grpc::Status s =
        method == "GetWorld" ? stub->GetWorld(&context, {}, &answer) : stub->DrainRegion(&context, {}, &drained);
    return s.ok() ? answer.name() : s.error_message().substr(0, s.error_message().find(':'));
  };
  EXPECT_EQ(say("GetWorld", watch, "a"), "one");
  EXPECT_EQ(say("GetWorld", operate, "b"), "two");
  EXPECT_EQ(say("GetWorld", watch, "b"), "WRONG_WORLD authorization");
  EXPECT_EQ(say("DrainRegion", watch, "a"), "NO_RIGHT");
  EXPECT_EQ(say("DrainRegion", operate, "a"), "WRONG_WORLD authorization");
  EXPECT_EQ(say("GetWorld", watch, ""), "MISSING aureole-world");
  EXPECT_EQ(say("GetWorld", watch, "c"), "NO_SUCH_WORLD aureole-world");
  EXPECT_EQ(say("GetWorld", "none of ours", "c"), "TOKEN_UNKNOWN authorization") << "a stranger hears of no world";
  // Who has a token for one world does not hear of the others.
  grpc::ClientContext context;
  context.AddMetadata("authorization", "Bearer " + watch);
  v1::ControlledWorld answer;
  const std::string names = v1::ControlPlane::NewStub(channel)->GetWorld(&context, {}, &answer).error_message();
  EXPECT_TRUE(names.ends_with("here run: a")) << names;
  // Operators' tokens let no server join.
  EXPECT_EQ(Call(channel, kJoin, operate), "NOT_A_SERVER no token opens it");
  server->Shutdown(std::chrono::system_clock::now());
}

TEST_F(Tokens, SecondTokenOfACallIsRefused) {
  const std::string token = Token({"watch"});
  const GuardedServer server(Open("", TokenPath()));
  EXPECT_EQ(Call(client::ChannelTo(server.endpoint(), {"", token}, Fresh()), kGetWorld, token), "NO_TOKEN");
}

TEST_F(Tokens, FileIsReadAgainWhenItChangesAndKeptWhenItIsBroken) {
  const std::string first = Token({"watch"});
  const GuardedServer server(Open("", TokenPath()));
  const auto channel = client::ChannelTo(server.endpoint(), {}, Fresh());
  const auto await = [&](const std::string& token, const std::string& said) {
    const auto until = std::chrono::steady_clock::now() + seconds(30);
    while (Call(channel, kGetWorld, token) != said && std::chrono::steady_clock::now() < until) {
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
    return Call(channel, kGetWorld, token);
  };
  EXPECT_EQ(Call(channel, kGetWorld, first), "NO_REGION");
  std::filesystem::remove(TokenPath());
  const std::string second = Token({"watch"});
  EXPECT_EQ(await(second, "NO_REGION"), "NO_REGION");
  EXPECT_EQ(Call(channel, kGetWorld, first), "TOKEN_UNKNOWN");
  ASSERT_TRUE(WriteFile(TokenPath(), "{\"tokens\": [{}]}", 0600).ok());
  std::this_thread::sleep_for(std::chrono::milliseconds(1100));  // it is looked up once a second
  EXPECT_EQ(Call(channel, kGetWorld, second), "NO_REGION");
}

TEST_F(Tokens, NeverGoInPlainTextToAnotherMachine) {
  const std::string token = Token({"watch"});
  const GuardedServer server(Open("", TokenPath()));
  // A name that is not known to be of this machine, though it is.
  const std::string port = server.endpoint().substr(server.endpoint().rfind(':'));
  EXPECT_EQ(Call(client::ChannelTo("127.0.0.1" + port, {"", token}, Fresh()), kGetWorld), "NO_REGION");
  EXPECT_EQ(Call(client::ChannelTo("dns:///localhost" + port, {"", token}, Fresh()), kGetWorld), "NO_TOKEN");
}

// The certificate that the server shows on a new connection.
std::string Shown(const std::string& endpoint, const KeyedCertificate& authority) {
  const auto stub = v1::Simulation::NewStub(client::ChannelTo(endpoint, Trusting(authority), Fresh()));
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + seconds(20));
  v1::GetWorldResponse answer;
  stub->GetWorld(&context, {}, &answer);
  const auto shown = context.auth_context()->FindPropertyValues(GRPC_X509_PEM_CERT_PROPERTY_NAME);
  return shown.empty() ? "" : std::string(shown[0].data(), shown[0].size());
}

TEST_F(Rotation, NewCertificateIsServedWithoutARestartAndOldConnectionsGoOn) {
  const std::string directory = Certificates("server");
  const std::string first = TextOf(directory + "/tls.crt");
  GuardedServer server(Open(directory));
  PeerLink link({GuardedServer::Identity(0), 1, [](const Frame&) {}, [](RegionId, const std::string&) {}, false, {}});
  const auto dialler = Open(Certificates("dialler"));
  link.Dial(server.endpoint(), dialler->channel());
  ASSERT_TRUE(link.AwaitWritten(seconds(30)));
  EXPECT_EQ(Shown(server.endpoint(), authority_), first);
  Certificates("server");
  const std::string second = TextOf(directory + "/tls.crt");
  ASSERT_NE(first, second);
  const auto until = std::chrono::steady_clock::now() + seconds(30);
  while (Shown(server.endpoint(), authority_) != second && std::chrono::steady_clock::now() < until) {
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
  }
  EXPECT_EQ(Shown(server.endpoint(), authority_), second);
  EXPECT_EQ(link.stats().connections, 1);
  link.Send(std::make_shared<const std::string>(EncodeFrame(Frame{})));
  EXPECT_TRUE(server.AwaitFrame());
  EXPECT_EQ(link.stats().connections, 1);
}

TEST_F(Rotation, CallerShowsItsNewCertificate) {
  const GuardedServer server(Open(Certificates("server")));
  const std::string directory = Certificates("caller", authority_, authority_, Over());
  const auto caller = Open(directory);
  EXPECT_EQ(CallAs(*caller, server.endpoint()), "NOT_A_SERVER certificate has expired");
  Certificates("caller");
  const auto until = std::chrono::steady_clock::now() + seconds(30);
  std::string said;
  do said = CallAs(*caller, server.endpoint());
  while (said != kAdmitted && std::chrono::steady_clock::now() < until);
  EXPECT_EQ(said, kAdmitted);
}

TEST(Listening, PlainTextBeyondThisMachineNeedsAFlag) {
  const auto check = [](const SecurityOptions& options, const std::string& address, bool clients) {
    return std::string(Must(Security::Open(options))->CheckListen(address, clients).message());
  };
  const SecurityOptions plain;
  SecurityOptions insecure;
  insecure.insecure = true;
  for (const char* here : {"127.0.0.1:0", "localhost:1", "[::1]:1", "127.1.2.3:1", "unix:/tmp/x"}) {
    EXPECT_EQ(check(plain, here, true), "") << here;
  }
  for (const char* beyond : {"0.0.0.0:0", "[::]:0", "10.0.0.1:1", "127.0.0.1.example.org:1", "localhost.org:1", ""}) {
    EXPECT_NE(check(plain, beyond, true).find("--insecure"), std::string::npos) << beyond;
    EXPECT_EQ(check(insecure, beyond, true), "") << beyond;
    EXPECT_FALSE(Must(Security::Open(plain))->CheckDial(beyond).ok()) << beyond;
    EXPECT_TRUE(Must(Security::Open(insecure))->CheckDial(beyond).ok()) << beyond;
  }
}

TEST_F(SecurityTest, BeyondThisMachineClientsNeedTokensAndTokensNeedTls) {
  Token({"watch"});
  SecurityOptions tls, tokens, both;
  tls.tls = both.tls = Certificates("server");
  tokens.tokens = both.tokens = TokenPath();
  tokens.insecure = true;
  const std::string beyond = "0.0.0.0:0";
  EXPECT_NE(Must(Security::Open(tls))->CheckListen(beyond, true).message().find("--tokens"), std::string::npos);
  EXPECT_TRUE(Must(Security::Open(tls))->CheckListen(beyond, false).ok());
  EXPECT_NE(Must(Security::Open(tokens))->CheckListen(beyond, true).message().find("--tls"), std::string::npos);
  EXPECT_TRUE(Must(Security::Open(both))->CheckListen(beyond, true).ok());
}

TEST_F(SecurityTest, FilesThatAreNotSaneAreRefusedWithTheFlag) {
  const auto open = [](const std::string& tls, const std::string& tokens) {
    SecurityOptions options;
    options.tls = tls;
    options.tokens = tokens;
    return std::string(Security::Open(options).status().message());
  };
  const std::string directory = Certificates("server");
  EXPECT_NE(open(directory_ / "nothing", "").find("--tls: "), std::string::npos);
  ASSERT_TRUE(WriteFile(directory + "/tls.key", "no key\n", 0600).ok());
  EXPECT_NE(open(directory, "").find("tls.key is not PEM"), std::string::npos) << open(directory, "");
  EXPECT_NE(open("", TokenPath()).find("--tokens: "), std::string::npos);
  const auto tokens = [&](const std::string& json) {
    EXPECT_TRUE(WriteFile(TokenPath(), json, 0600).ok());
    return open("", TokenPath());
  };
  const std::string hash = Sha256Hex("x");
  const std::string entry = "{\"name\":\"a\",\"world\":\"w\",\"rights\":[\"WATCH\"],\"sha256\":\"" + hash + "\"}";
  EXPECT_EQ(tokens("{\"tokens\":[" + entry + "]}"), "");
  EXPECT_NE(tokens("").find("--tokens: "), std::string::npos);
  EXPECT_NE(tokens("{\"tokens\":[" + entry + "," + entry + "]}").find("tokens[1].sha256"), std::string::npos);
  EXPECT_NE(
      tokens("{\"tokens\":[{\"name\":\"a\",\"world\":\"w\",\"sha256\":\"" + hash + "\"}]}").find("tokens[0].rights"),
      std::string::npos);
  EXPECT_NE(tokens("{\"tokens\":[{\"name\":\"a\",\"rights\":[\"WATCH\"],\"sha256\":\"" + hash + "\"}]}")
                .find("tokens[0].world"),
            std::string::npos);
}

}  // namespace
}  // namespace aureole
