#include "server/transport/server_certificate.h"

#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/x509.h>
#include <openssl/x509v3.h>

#include <memory>
#include <vector>

#include <absl/strings/str_cat.h>

#include "server/transport/openssl_ptr.h"

namespace aureole {
namespace {

using Certificate = OpensslPtr<X509, X509_free>;

std::vector<Certificate> Read(const std::string& pem) {
  const OpensslPtr<BIO, BIO_free_all> in(BIO_new_mem_buf(pem.data(), static_cast<int>(pem.size())));
  std::vector<Certificate> out;
  while (X509* certificate = PEM_read_bio_X509(in.get(), nullptr, nullptr, nullptr)) out.emplace_back(certificate);
  ERR_clear_error();  // the end of the text is one
  return out;
}

}  // namespace

absl::Status CheckServerCertificate(const std::string& chain, const std::string& authorities) {
  const std::vector<Certificate> shown = Read(chain), trusted = Read(authorities);
  if (shown.empty()) return absl::UnauthenticatedError("there is no certificate");
  if (trusted.empty()) return absl::UnauthenticatedError("there is no authority to trust");
  const OpensslPtr<X509_STORE, X509_STORE_free> store(X509_STORE_new());
  const OpensslPtr<X509_STORE_CTX, X509_STORE_CTX_free> check(X509_STORE_CTX_new());
  // Certificates stay ours.
  const std::unique_ptr<STACK_OF(X509), OpensslFree<[](STACK_OF(X509) * s) { sk_X509_free(s); }>> between(
      sk_X509_new_null());
  bool made = store != nullptr && check != nullptr && between != nullptr;
  for (const Certificate& c : trusted) made = made && X509_STORE_add_cert(store.get(), c.get()) == 1;
  for (const Certificate& c : shown) made = made && sk_X509_push(between.get(), c.get()) > 0;
  if (!made || X509_STORE_CTX_init(check.get(), store.get(), shown[0].get(), between.get()) != 1 ||
      X509_STORE_CTX_set_default(check.get(), "ssl_client") != 1) {
    ERR_clear_error();
    return absl::UnauthenticatedError("OpenSSL cannot check it");
  }
  // An authority may itself be signed by one that is not here.
  X509_STORE_CTX_set_flags(check.get(), X509_V_FLAG_PARTIAL_CHAIN);
  if (X509_verify_cert(check.get()) != 1) {
    ERR_clear_error();
    return absl::UnauthenticatedError(X509_verify_cert_error_string(X509_STORE_CTX_get_error(check.get())));
  }
  constexpr unsigned kExactly = X509_CHECK_FLAG_NO_WILDCARDS | X509_CHECK_FLAG_NEVER_CHECK_SUBJECT;
  if (X509_check_host(shown[0].get(), kServerName, 0, kExactly, nullptr) != 1) {
    return absl::UnauthenticatedError(absl::StrCat("it does not have the DNS name ", kServerName));
  }
  return absl::OkStatus();
}

}  // namespace aureole
