#include "tests/kubernetes/tls_keys.h"

#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <openssl/x509v3.h>

#include "server/core/check.h"

namespace aureole::kubernetes {
namespace {

template <auto kFree>
struct Free {
  template <typename T>
  void operator()(T* p) const {
    kFree(p);
  }
};
using Key = std::unique_ptr<EVP_PKEY, Free<EVP_PKEY_free>>;
using Certificate = std::unique_ptr<X509, Free<X509_free>>;
using Bio = std::unique_ptr<BIO, Free<BIO_free_all>>;

std::string TextOf(BIO* bio) {
  char* data = nullptr;
  const long bytes = BIO_get_mem_data(bio, &data);
  return {data, static_cast<size_t>(bytes)};
}

std::string PemOf(X509* certificate) {
  const Bio bio(BIO_new(BIO_s_mem()));
  PEM_write_bio_X509(bio.get(), certificate);
  return TextOf(bio.get());
}

std::string PemOf(EVP_PKEY* key) {
  const Bio bio(BIO_new(BIO_s_mem()));
  PEM_write_bio_PrivateKey(bio.get(), key, nullptr, nullptr, 0, nullptr, nullptr);
  return TextOf(bio.get());
}

Certificate CertificateFrom(const std::string& pem) {
  const Bio bio(BIO_new_mem_buf(pem.data(), static_cast<int>(pem.size())));
  return Certificate(PEM_read_bio_X509(bio.get(), nullptr, nullptr, nullptr));
}

Key KeyFrom(const std::string& pem) {
  const Bio bio(BIO_new_mem_buf(pem.data(), static_cast<int>(pem.size())));
  return Key(PEM_read_bio_PrivateKey(bio.get(), nullptr, nullptr, nullptr));
}

void Extend(X509* certificate, int kind, const std::string& value) {
  X509_EXTENSION* const extension = X509V3_EXT_conf_nid(nullptr, nullptr, kind, value.c_str());
  AUREOLE_CHECK(extension != nullptr, "%s", value.c_str());
  X509_add_ext(certificate, extension, -1);
  X509_EXTENSION_free(extension);
}

// Signed by itself when there is no issuer.
Certificate Make(const std::string& name, EVP_PKEY* key, X509* issuer, EVP_PKEY* issuer_key, const std::string& ip) {
  static long serial = 1;
  Certificate out(X509_new());
  X509_set_version(out.get(), 2);
  ASN1_INTEGER_set(X509_get_serialNumber(out.get()), serial++);
  X509_gmtime_adj(X509_getm_notBefore(out.get()), -3600);
  X509_gmtime_adj(X509_getm_notAfter(out.get()), 3600);
  X509_NAME_add_entry_by_txt(X509_get_subject_name(out.get()), "CN", MBSTRING_ASC,
                             reinterpret_cast<const unsigned char*>(name.c_str()), -1, -1, 0);
  X509_set_issuer_name(out.get(), X509_get_subject_name(issuer == nullptr ? out.get() : issuer));
  X509_set_pubkey(out.get(), key);
  Extend(out.get(), NID_basic_constraints, issuer == nullptr ? "critical,CA:TRUE" : "CA:FALSE");
  if (!ip.empty()) Extend(out.get(), NID_subject_alt_name, "IP:" + ip);
  AUREOLE_CHECK(X509_sign(out.get(), issuer_key, EVP_sha256()) > 0, "cannot sign");
  return out;
}

}  // namespace

TlsKeys MakeTlsKeys(const std::string& address, const std::string& authority) {
  const Key ca_key(EVP_EC_gen("P-256")), server_key(EVP_EC_gen("P-256")), client_key(EVP_EC_gen("P-256"));
  const Certificate ca = Make(authority, ca_key.get(), nullptr, ca_key.get(), "");
  TlsKeys keys;
  keys.ca = PemOf(ca.get());
  keys.server_certificate = PemOf(Make("server", server_key.get(), ca.get(), ca_key.get(), address).get());
  keys.server_key = PemOf(server_key.get());
  keys.client_certificate = PemOf(Make("client", client_key.get(), ca.get(), ca_key.get(), "").get());
  keys.client_key = PemOf(client_key.get());
  return keys;
}

std::unique_ptr<httplib::Server> TlsKeys::NewServer() const {
  const Certificate certificate = CertificateFrom(server_certificate);
  const Key key = KeyFrom(server_key);
  X509_STORE* const clients = X509_STORE_new();  // the server's
  X509_STORE_add_cert(clients, CertificateFrom(ca).get());
  auto server = std::make_unique<httplib::SSLServer>(certificate.get(), key.get(), clients);
  AUREOLE_CHECK(server->is_valid(), "no TLS server");
  return server;
}

}  // namespace aureole::kubernetes
