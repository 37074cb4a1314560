// Owners of OpenSSL's objects.
#pragma once

#include <memory>

namespace aureole {

template <auto free>
struct OpensslFree {
  template <class T>
  void operator()(T* p) const {
    free(p);
  }
};
// As in OpensslPtr<X509, X509_free>.
template <class T, auto free>
using OpensslPtr = std::unique_ptr<T, OpensslFree<free>>;

}  // namespace aureole
