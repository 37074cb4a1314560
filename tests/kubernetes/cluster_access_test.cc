// Kubeconfigs, service accounts and tokens: what is read, and what is refused with the file and the field.
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>

#include <absl/strings/escaping.h>
#include <absl/strings/match.h>
#include <absl/strings/str_cat.h>
#include <absl/strings/str_replace.h>

#include "server/control/kubernetes/bearer_token.h"
#include "server/control/kubernetes/cluster_access.h"

namespace aureole::kubernetes {
namespace {

constexpr char kPem[] = "-----BEGIN CERTIFICATE-----\nAA==\n-----END CERTIFICATE-----\n";

class Access : public testing::Test {
 protected:
  Access() {
    std::string name = (std::filesystem::temp_directory_path() / "access.XXXXXX").string();
    directory_ = mkdtemp(name.data());
  }
  ~Access() override { std::filesystem::remove_all(directory_); }

  std::string Write(const std::string& name, const std::string& text) {
    std::ofstream(directory_ / name, std::ios::binary) << text;
    return (directory_ / name).string();
  }
  void SetUp() override {
    Write("ca.crt", kPem);
    Write("token", "secret\n");
    Write("namespace", "aureole\n");
    Write("user.crt", kPem);
    Write("user.key", kPem);
  }
  std::string directory() const { return directory_.string(); }

 private:
  std::filesystem::path directory_;
};

std::string Config() {
  return R"(apiVersion: v1
kind: Config
clusters:
- name: other
  cluster: {server: "https://192.0.2.1:6443", certificate-authority: missing.crt}
- name: k
  cluster:
    server: https://127.0.0.1:6443/
    certificate-authority: ca.crt
users:
- name: u
  user:
    client-certificate: user.crt
    client-key: user.key
contexts:
- name: c
  context: {cluster: k, user: u, namespace: physics}
current-context: c
)";
}

TEST_F(Access, KubeconfigNamesServerAuthorityCertificateAndNamespace) {
  const auto access = KubeconfigAccess(Write("config", Config()));
  ASSERT_TRUE(access.ok()) << access.status();
  EXPECT_EQ(access->server, "https://127.0.0.1:6443");
  EXPECT_EQ(access->ca, kPem);
  EXPECT_EQ(access->client_certificate, kPem);
  EXPECT_EQ(access->client_key, kPem);
  EXPECT_EQ(access->space, "physics");
  EXPECT_EQ(access->token, "");
}

TEST_F(Access, KubeconfigHoldsDataInBase64AndTokens) {
  const std::string pem = absl::Base64Escape(kPem);
  const std::string with_data =
      absl::StrReplaceAll(Config(), {{"    certificate-authority: ca.crt", "    certificate-authority-data: " + pem},
                                     {"    client-certificate: user.crt\n", "    token: abc\n"},
                                     {"    client-key: user.key\n", "    tokenFile: token\n"},
                                     {", namespace: physics", ""}});
  const auto access = KubeconfigAccess(Write("config", with_data));
  ASSERT_TRUE(access.ok()) << access.status();
  EXPECT_EQ(access->ca, kPem);
  EXPECT_EQ(access->token, "abc");
  EXPECT_EQ(access->token_file, directory() + "/token");
  EXPECT_EQ(access->space, "default");
}

TEST_F(Access, KubeconfigThatCannotBeUsedIsRefusedWithFileAndField) {
  struct Case {
    const char *from, *to, *message;
  };
  const Case cases[] = {
      {"current-context: c", "current-context: d", "current-context: 'd' is not among the contexts"},
      {"current-context: c", "", "current-context: missing"},
      {"cluster: k,", "cluster: z,", "contexts[c].context.cluster: 'z' is not among the clusters"},
      {"user: u,", "user: z,", "contexts[c].context.user: 'z' is not among the users"},
      {"    server: https://127.0.0.1:6443/\n", "", "clusters[k].cluster.server: missing"},
      {"https://127.0.0.1:6443/", "http://192.0.2.1:80", "clusters[k].cluster.server: 'http://192.0.2.1:80' must"},
      {"https://127.0.0.1:6443/", "http://localhost.example:80", "must begin with https://"},
      {"certificate-authority: ca.crt\nusers", "x: y\nusers", "clusters[k].cluster.certificate-authority: missing"},
      {"certificate-authority: ca.crt", "certificate-authority: no.crt", "clusters[k].cluster.certificate-authority: "},
      {"certificate-authority: ca.crt", "certificate-authority: token", "holds no PEM block"},
      {"certificate-authority: ca.crt", "certificate-authority-data: '*'", "certificate-authority-data: not base64"},
      {"certificate-authority: ca.crt", "insecure-skip-tls-verify: true", "insecure-skip-tls-verify: not supported"},
      {"certificate-authority: ca.crt", "proxy-url: http://192.0.2.1", "clusters[k].cluster.proxy-url: not supported"},
      {"    client-key: user.key\n", "", "users[u].user.client-key: missing"},
      {"    client-certificate: user.crt\n", "", "users[u].user.client-certificate: missing"},
      {"client-key: user.key", "exec: {command: aws}", "users[u].user.exec: not supported; give a token"},
      {"client-key: user.key", "as: admin", "users[u].user.as: not supported"},
      {"client-key: user.key", "as-groups: [admins]", "users[u].user.as-groups: not supported"},
      {"client-key: user.key", "password: x", "users[u].user.password: not supported"},
      {"    client-key: user.key\n", "    client-key: user.key\n    tokenFile: none\n", "users[u].user.tokenFile: "},
      {"    client-key: user.key\n", "    client-key: user.key\n    token: \"a\\r\\nX: y\"\n",
       "users[u].user.token: has characters"},
      {"clusters:", "clusters: {", "yaml-cpp: error at line"},
  };
  for (const Case& c : cases) {
    const std::string text = absl::StrReplaceAll(Config(), {{c.from, c.to}});
    ASSERT_NE(text, Config()) << c.from;
    const std::string path = Write("config", text);
    const absl::Status status = KubeconfigAccess(path).status();
    ASSERT_FALSE(status.ok()) << c.to;
    EXPECT_TRUE(absl::StartsWith(status.message(), path + ": ")) << status;
    EXPECT_TRUE(absl::StrContains(status.message(), c.message)) << status << "\nwanted: " << c.message;
  }
  EXPECT_TRUE(absl::IsInvalidArgument(KubeconfigAccess(Write("config", "just words")).status()));
  EXPECT_TRUE(absl::IsNotFound(KubeconfigAccess(directory() + "/none").status()));
  EXPECT_TRUE(absl::IsNotFound(KubeconfigAccess(directory()).status()));
}

TEST_F(Access, ServiceAccountIsThatOfThePod) {
  const auto access = ServiceAccountAccess("10.96.0.1", "443", directory());
  ASSERT_TRUE(access.ok()) << access.status();
  EXPECT_EQ(access->server, "https://10.96.0.1:443");
  EXPECT_EQ(access->ca, kPem);
  EXPECT_EQ(access->token_file, directory() + "/token");
  EXPECT_EQ(access->space, "aureole");
  EXPECT_EQ(ServiceAccountAccess("fd00::1", "443", directory())->server, "https://[fd00::1]:443");
  EXPECT_TRUE(absl::StrContains(ServiceAccountAccess("", "443", directory()).status().message(),
                                "KUBERNETES_SERVICE_HOST: not set"));
  for (const char* file : {"ca.crt", "token", "namespace"}) {
    std::filesystem::rename(directory() + "/" + file, directory() + "/away");
    const absl::Status status = ServiceAccountAccess("10.96.0.1", "443", directory()).status();
    EXPECT_TRUE(absl::StartsWith(status.message(), directory() + "/" + file + ": cannot be read")) << status;
    std::filesystem::rename(directory() + "/away", directory() + "/" + file);
  }
}

TEST_F(Access, FlagGoesBeforeEnvironmentBeforeServiceAccount) {
  const std::string flag = Write("flag", Config());
  const std::string variable = Write("variable", absl::StrReplaceAll(Config(), {{"physics", "variable"}}));
  setenv("KUBECONFIG", variable.c_str(), 1);
  EXPECT_EQ(FindAccess(flag)->space, "physics");
  EXPECT_EQ(FindAccess("")->space, "variable");
  setenv("KUBECONFIG", (variable + ":" + flag).c_str(), 1);
  EXPECT_TRUE(absl::StartsWith(FindAccess("").status().message(), "KUBECONFIG: "));
  unsetenv("KUBECONFIG");
  setenv("HOME", directory().c_str(), 1);
  EXPECT_TRUE(absl::IsNotFound(FindAccess("").status())) << FindAccess("").status();
  std::filesystem::create_directory(directory() + "/.kube");
  Write(".kube/config", absl::StrReplaceAll(Config(), {{"ca.crt", "../ca.crt"}, {": user.", ": ../user."}}));
  EXPECT_EQ(FindAccess("")->space, "physics") << FindAccess("").status();
}

TEST_F(Access, TokenIsReadAgainAfterAMinuteAndAfterARefusal) {
  using std::chrono::seconds;
  BearerToken token("", Write("token", "one\n"));
  const BearerToken::Clock::time_point start{};
  EXPECT_EQ(token.Get(start).value(), "one");
  Write("token", "two\n");
  EXPECT_EQ(token.Get(start + seconds(59)).value(), "one");
  EXPECT_EQ(token.Get(start + seconds(60)).value(), "two");
  EXPECT_FALSE(token.RenewAfterRefusal("two", start + seconds(61)));
  Write("token", "three");
  EXPECT_TRUE(token.RenewAfterRefusal("two", start + seconds(62)));
  EXPECT_EQ(token.Get(start + seconds(62)).value(), "three");
  // What cannot be read, or is half written, leaves the last one.
  Write("token", "");
  EXPECT_EQ(token.Get(start + seconds(300)).value(), "three");
  Write("token", "a\r\nInjected: b");
  EXPECT_EQ(token.Get(start + seconds(400)).value(), "three");
  EXPECT_FALSE(BearerToken("", directory() + "/none").Get().ok());
  EXPECT_EQ(BearerToken("fixed", "").Get().value(), "fixed");
  EXPECT_FALSE(BearerToken("fixed", "").RenewAfterRefusal("fixed"));
}

}  // namespace
}  // namespace aureole::kubernetes
