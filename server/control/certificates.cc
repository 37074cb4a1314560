#include "server/control/certificates.h"

#include <arpa/inet.h>
#include <openssl/bio.h>
#include <openssl/ec.h>
#include <openssl/err.h>
#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/rand.h>
#include <openssl/x509.h>
#include <openssl/x509v3.h>

#include <filesystem>
#include <fstream>
#include <memory>
#include <sstream>

#include <absl/strings/str_cat.h>
#include <absl/strings/str_join.h>
#include <absl/time/clock.h>

#include "server/control/write_file.h"
#include "server/transport/openssl_ptr.h"
#include "server/transport/server_certificate.h"

namespace aureole {
namespace {

using Bio = OpensslPtr<BIO, BIO_free_all>;
using Key = OpensslPtr<EVP_PKEY, EVP_PKEY_free>;
using Certificate = OpensslPtr<X509, X509_free>;
using Extension = OpensslPtr<X509_EXTENSION, X509_EXTENSION_free>;

constexpr absl::Duration kAuthorityValid = absl::Hours(24 * 3650);
// Clocks of other machines may be behind.
constexpr absl::Duration kClockSkew = absl::Minutes(5);

absl::Status OpenSslError(const std::string& what) {
  char text[256];
  ERR_error_string_n(ERR_get_error(), text, sizeof text);
  ERR_clear_error();
  return absl::InternalError(absl::StrCat(what, ": ", text));
}

std::string Contents(BIO* bio) {
  char* data = nullptr;
  const long size = BIO_get_mem_data(bio, &data);
  return {data, static_cast<size_t>(size)};
}

Bio Reading(const std::string& text) { return Bio(BIO_new_mem_buf(text.data(), static_cast<int>(text.size()))); }

bool AddExtension(X509* certificate, X509* issuer, int kind, const std::string& value) {
  X509V3_CTX context;
  X509V3_set_ctx_nodb(&context);
  X509V3_set_ctx(&context, issuer, certificate, nullptr, nullptr, 0);
  const Extension extension(X509V3_EXT_conf_nid(nullptr, &context, kind, value.c_str()));
  return extension != nullptr && X509_add_ext(certificate, extension.get(), -1) == 1;
}

std::string SubjectAltName(const std::string& name) {
  unsigned char address[sizeof(in6_addr)];
  const bool ip = inet_pton(AF_INET, name.c_str(), address) == 1 || inet_pton(AF_INET6, name.c_str(), address) == 1;
  return absl::StrCat(ip ? "IP:" : "DNS:", name);
}

// A random serial of 159 bits, who, when, and the key.
bool FillIn(X509* certificate, EVP_PKEY* key, const std::string& name, const Validity& validity) {
  unsigned char serial[20];
  if (RAND_bytes(serial, sizeof serial) != 1) return false;
  serial[0] &= 0x7f;
  const OpensslPtr<BIGNUM, BN_free> number(BN_bin2bn(serial, sizeof serial, nullptr));
  return number != nullptr && BN_to_ASN1_INTEGER(number.get(), X509_get_serialNumber(certificate)) != nullptr &&
         X509_set_version(certificate, X509_VERSION_3) == 1 && X509_set_pubkey(certificate, key) == 1 &&
         ASN1_TIME_set(X509_getm_notBefore(certificate), absl::ToTimeT(validity.from)) != nullptr &&
         ASN1_TIME_set(X509_getm_notAfter(certificate), absl::ToTimeT(validity.until)) != nullptr &&
         X509_NAME_add_entry_by_txt(X509_get_subject_name(certificate), "CN", MBSTRING_UTF8,
                                    reinterpret_cast<const unsigned char*>(name.data()), static_cast<int>(name.size()),
                                    -1, 0) == 1;
}

absl::StatusOr<KeyedCertificate> ToPem(X509* certificate, EVP_PKEY* key) {
  const Bio certificate_out(BIO_new(BIO_s_mem())), key_out(BIO_new(BIO_s_mem()));
  if (PEM_write_bio_X509(certificate_out.get(), certificate) != 1 ||
      PEM_write_bio_PKCS8PrivateKey(key_out.get(), key, nullptr, nullptr, 0, nullptr, nullptr) != 1) {
    return OpenSslError("a certificate cannot be written");
  }
  return KeyedCertificate{Contents(certificate_out.get()), Contents(key_out.get())};
}

absl::StatusOr<std::string> ReadFile(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  if (!file || !(text << file.rdbuf()))
    return absl::PermissionDeniedError(absl::StrCat(path.string(), ": cannot be read"));
  return text.str();
}

}  // namespace

absl::StatusOr<KeyedCertificate> MakeAuthority(const std::string& name, const Validity& validity) {
  const Key key(EVP_EC_gen("P-256"));
  const Certificate out(X509_new());
  if (key == nullptr || out == nullptr || !FillIn(out.get(), key.get(), name, validity) ||
      X509_set_issuer_name(out.get(), X509_get_subject_name(out.get())) != 1 ||
      !AddExtension(out.get(), out.get(), NID_basic_constraints, "critical,CA:TRUE,pathlen:0") ||
      !AddExtension(out.get(), out.get(), NID_key_usage, "critical,keyCertSign,cRLSign") ||
      !AddExtension(out.get(), out.get(), NID_subject_key_identifier, "hash") ||
      X509_sign(out.get(), key.get(), EVP_sha256()) == 0) {
    return OpenSslError("an authority cannot be made");
  }
  return ToPem(out.get(), key.get());
}

absl::StatusOr<KeyedCertificate> MakeCertificate(const KeyedCertificate& authority, const std::string& name,
                                                 const std::vector<std::string>& names, const Validity& validity) {
  const Certificate issuer(PEM_read_bio_X509(Reading(authority.certificate).get(), nullptr, nullptr, nullptr));
  const Key issuer_key(PEM_read_bio_PrivateKey(Reading(authority.key).get(), nullptr, nullptr, nullptr));
  if (issuer == nullptr || issuer_key == nullptr) return OpenSslError("the authority cannot be read");
  const Key key(EVP_EC_gen("P-256"));
  const Certificate out(X509_new());
  const std::string alternatives = absl::StrJoin(
      names, ",", [](std::string* text, const std::string& n) { absl::StrAppend(text, SubjectAltName(n)); });
  if (key == nullptr || out == nullptr || !FillIn(out.get(), key.get(), name, validity) ||
      X509_set_issuer_name(out.get(), X509_get_subject_name(issuer.get())) != 1 ||
      !AddExtension(out.get(), issuer.get(), NID_basic_constraints, "critical,CA:FALSE") ||
      !AddExtension(out.get(), issuer.get(), NID_key_usage, "critical,digitalSignature") ||
      !AddExtension(out.get(), issuer.get(), NID_ext_key_usage, "serverAuth,clientAuth") ||
      !AddExtension(out.get(), issuer.get(), NID_subject_key_identifier, "hash") ||
      !AddExtension(out.get(), issuer.get(), NID_authority_key_identifier, "keyid") ||
      (!names.empty() && !AddExtension(out.get(), issuer.get(), NID_subject_alt_name, alternatives)) ||
      X509_sign(out.get(), issuer_key.get(), EVP_sha256()) == 0) {
    return OpenSslError("a certificate cannot be made");
  }
  return ToPem(out.get(), key.get());
}

absl::Status WriteCertificates(const std::string& directory, const std::vector<std::string>& names,
                               absl::Duration valid) {
  const std::filesystem::path base = directory;
  std::error_code error;
  std::filesystem::create_directories(base, error);
  const absl::Time from = absl::Now() - kClockSkew;
  const bool has_key = std::filesystem::exists(base / "ca.key"),
             has_certificate = std::filesystem::exists(base / "ca.crt");
  if (has_key != has_certificate) {
    return absl::InvalidArgumentError(absl::StrCat(directory,
                                                   ": has only one of ca.key and ca.crt; an authority is both: "
                                                   "add the other, or use an empty directory"));
  }
  KeyedCertificate authority;
  if (has_key) {
    const absl::StatusOr<std::string> certificate = ReadFile(base / "ca.crt"), key = ReadFile(base / "ca.key");
    if (!certificate.ok()) return certificate.status();
    if (!key.ok()) return key.status();
    authority = {*certificate, *key};
  } else {
    absl::StatusOr<KeyedCertificate> made = MakeAuthority("Aureole", {from, from + kAuthorityValid});
    if (!made.ok()) return made.status();
    authority = *std::move(made);
    if (absl::Status s = WriteFile(base / "ca.key", authority.key, 0600); !s.ok()) return s;
    if (absl::Status s = WriteFile(base / "ca.crt", authority.certificate, 0644); !s.ok()) return s;
  }
  std::vector<std::string> all = {kServerName, "localhost", "127.0.0.1", "::1"};
  all.insert(all.end(), names.begin(), names.end());
  const absl::StatusOr<KeyedCertificate> server =
      MakeCertificate(authority, kServerName, all, {from, absl::Now() + valid});
  if (!server.ok()) return server.status();
  if (absl::Status s = WriteFile(base / "tls.key", server->key, 0600); !s.ok()) return s;
  return WriteFile(base / "tls.crt", server->certificate, 0644);
}

}  // namespace aureole
