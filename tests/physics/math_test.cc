// The maths library of deterministic_math.cc: that Bullet uses it, that it is accurate, that it ignores the CPU.
#include <dlfcn.h>

#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>

#include <gtest/gtest.h>

#include "server/physics/deterministic_math.h"
#include "tests/physics/main.h"
#include "tests/physics/scene.h"

namespace aureole {
namespace {

using Unary = double (*)(double);
using Binary = double (*)(double, double);

void* Glibc(const char* name) {
  static void* library = dlopen("libm.so.6", RTLD_NOW | RTLD_LOCAL);
  return dlsym(library, name);
}

double UlpsApart(double x, double y) {
  if (x == y || (std::isnan(x) && std::isnan(y))) return 0;
  const double ulp = std::abs(std::nextafter(y, std::numeric_limits<double>::infinity()) - y);
  return std::abs(x - y) / ulp;
}

double WorstUlps(const char* name, double low, double high) {
  const auto ours = reinterpret_cast<Unary>(dlsym(RTLD_DEFAULT, name));
  const auto reference = reinterpret_cast<Unary>(Glibc(name));
  double worst = 0;
  for (uint64_t i = 0; i < 200000; ++i) {
    const double x = Uniform(i, low, high);
    worst = std::max(worst, UlpsApart(ours(x), reference(x)));
  }
  return worst;
}

// All libraries of the process look the symbols up in the same scope, the executable first.
TEST(DeterministicMath, BulletCallsOurFunctions) {
  Dl_info self;
  ASSERT_NE(dladdr(reinterpret_cast<void*>(&DeterministicMathVersion), &self), 0);
  for (const char* name : {"sin", "cos", "sincos", "pow", "exp", "log", "atan", "atan2", "asin", "acos"}) {
    void* found = dlsym(RTLD_DEFAULT, name);
    ASSERT_NE(found, nullptr) << name;
    EXPECT_NE(found, Glibc(name)) << name;
    Dl_info info;
    ASSERT_NE(dladdr(found, &info), 0) << name;
    EXPECT_STREQ(info.dli_fname, self.dli_fname) << name;
  }
}

TEST(DeterministicMath, IsAccurate) {
  for (const char* name : {"sin", "cos"}) {
    EXPECT_LE(WorstUlps(name, -10, 10), 1) << name;
    EXPECT_LE(WorstUlps(name, -0.01, 0.01), 1) << name;
    EXPECT_LE(WorstUlps(name, -4e5, 4e5), 1) << name;
    EXPECT_LE(WorstUlps(name, 1e9, 1e10), 1) << name;
    EXPECT_LE(WorstUlps(name, 1e100, 1e102), 1) << name;
  }
  EXPECT_LE(WorstUlps("exp", -700, 700), 1);
  EXPECT_LE(WorstUlps("exp", -745, -700), 1);  // into the subnormals
  EXPECT_LE(WorstUlps("log", 1e-300, 1e-10), 1);
  EXPECT_LE(WorstUlps("log", 0.5, 2), 1);
  EXPECT_LE(WorstUlps("log", 0, 1e300), 1);
  EXPECT_LE(WorstUlps("atan", -10, 10), 2);
  EXPECT_LE(WorstUlps("asin", -1, 1), 3);
  EXPECT_LE(WorstUlps("acos", -1, 1), 3);
}

TEST(DeterministicMath, PowAndAtan2AreAccurate) {
  const auto pow_reference = reinterpret_cast<Binary>(Glibc("pow"));
  const auto atan2_reference = reinterpret_cast<Binary>(Glibc("atan2"));
  double worst_pow = 0, worst_atan2 = 0;
  for (uint64_t i = 0; i < 200000; ++i) {
    const double base = std::exp(Uniform(i, -20, 20)), power = Uniform(i + 7777777, -30, 30);
    worst_pow = std::max(worst_pow, UlpsApart(std::pow(base, power), pow_reference(base, power)));
    const double damping = Uniform(i, 0, 1);
    worst_pow = std::max(worst_pow, UlpsApart(std::pow(1 - damping, 0.016), pow_reference(1 - damping, 0.016)));
    const double y = Uniform(i, -3, 3), x = Uniform(i + 99999, -3, 3);
    worst_atan2 = std::max(worst_atan2, UlpsApart(std::atan2(y, x), atan2_reference(y, x)));
  }
  EXPECT_LE(worst_pow, 1);
  EXPECT_LE(worst_atan2, 2);
}

TEST(DeterministicMath, PowOfIntegersIsExact) {
  for (int base = 2; base <= 10; ++base) {
    double exact = 1;
    for (int n = 1; exact * base < 0x1p53; ++n) {
      exact *= base;
      EXPECT_EQ(std::pow(base, n), exact) << base << "^" << n;
    }
  }
}

TEST(DeterministicMath, AgreesWithTheStandardAtTheEdges) {
  constexpr double kInf = std::numeric_limits<double>::infinity();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const double edges[] = {0.0, -0.0, 1, -1, 0.5, -0.5, 2, -2, 3, -3, 1e308, -1e308, 5e-324, -5e-324, kInf, -kInf, nan};
  for (const char* name : {"pow", "atan2"}) {
    const auto ours = reinterpret_cast<Binary>(dlsym(RTLD_DEFAULT, name));
    const auto reference = reinterpret_cast<Binary>(Glibc(name));
    for (double x : edges) {
      for (double y : edges) {
        const double got = ours(x, y), want = reference(x, y);
        EXPECT_LE(UlpsApart(got, want), 1) << name << "(" << x << ", " << y << ") = " << got << ", not " << want;
        if (!std::isnan(want)) {
          EXPECT_EQ(std::signbit(got), std::signbit(want)) << name << " " << x << " " << y;
        }
      }
    }
  }
  for (const char* name : {"sin", "cos", "exp", "log", "atan", "asin", "acos"}) {
    const auto ours = reinterpret_cast<Unary>(dlsym(RTLD_DEFAULT, name));
    const auto reference = reinterpret_cast<Unary>(Glibc(name));
    for (double x : edges) EXPECT_LE(UlpsApart(ours(x), reference(x)), 2) << name << "(" << x << ")";
  }
}

std::string Output(const std::string& command) {
  std::string out;
  FILE* pipe = popen(command.c_str(), "r");
  if (pipe == nullptr) return out;
  char buffer[256];
  while (std::fgets(buffer, sizeof buffer, pipe) != nullptr) out += buffer;
  pclose(pipe);
  return out;
}

TEST(DeterministicMath, RunHasTheSameBitsWithoutFma) {
  const std::string run = "'" + TestExecutable() + "' --print-hash";
  const std::string plain = Output(run);
  EXPECT_EQ(plain.size(), 17u) << plain;
  EXPECT_EQ(Output("GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4 " + run), plain);
}

}  // namespace
}  // namespace aureole
