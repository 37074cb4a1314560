// sin, cos, pow and their kin with the same bits on every CPU (EXACT.md L9). glibc picks FMA variants at run time, with
// other last bits; these definitions are linked into every executable, where they come before glibc's for all shared
// libraries, Bullet's among them. Only + - * / sqrt and integers work here; contraction must stay off.
// Accuracy: pow, exp, log below 0.6 ulp, the others below 2 ulp, over the whole range of double.
// No <cmath>: its declarations and the compiler's built-ins would get in the way.
#include <cstdint>
#include <cstring>

#include "server/physics/deterministic_math.h"

namespace aureole {
namespace {

__extension__ using Wide = unsigned __int128;

constexpr double kHalfPi = 0x1.921fb54442d18p+0, kHalfPiLow = 0x1.1a62633145c07p-54;
constexpr double kPi = 0x1.921fb54442d18p+1, kPiLow = 0x1.1a62633145c07p-53;

uint64_t Bits(double x) {
  uint64_t b;
  std::memcpy(&b, &x, sizeof b);
  return b;
}
double FromBits(uint64_t b) {
  double x;
  std::memcpy(&x, &b, sizeof x);
  return x;
}
double Infinity() { return FromBits(0x7ff0000000000000); }
double NotANumber() { return FromBits(0x7ff8000000000000); }
bool IsNan(double x) { return x != x; }
bool IsInfinite(double x) { return x == Infinity() || x == -Infinity(); }
double Magnitude(double x) { return FromBits(Bits(x) & 0x7fffffffffffffff); }
double Sqrt(double x) { return __builtin_sqrt(x); }
bool Negative(double x) { return (Bits(x) >> 63) != 0; }

// A number as an unevaluated sum; |low| is at most half an ulp of high.
struct Pair {
  double high, low;
};

Pair FastSum(double a, double b) {  // |a| >= |b|
  const double s = a + b;
  return {s, b - (s - a)};
}
Pair Sum(double a, double b) {
  const double s = a + b, t = s - a;
  return {s, (a - (s - t)) + (b - t)};
}
Pair Product(double a, double b) {  // Dekker's, by Veltkamp's splitting: exact without FMA
  constexpr double kSplit = 134217729.0;
  const double p = a * b, ca = kSplit * a, cb = kSplit * b;
  const double ah = ca - (ca - a), al = a - ah, bh = cb - (cb - b), bl = b - bh;
  return {p, ((ah * bh - p) + ah * bl + al * bh) + al * bl};
}
Pair Product(Pair a, Pair b) {
  const Pair p = Product(a.high, b.high);
  return FastSum(p.high, p.low + (a.high * b.low + a.low * b.high));
}
Pair Sum(Pair a, Pair b) {
  const Pair s = Sum(a.high, b.high);
  return FastSum(s.high, s.low + (a.low + b.low));
}

// 2^n * x, correctly rounded once, also into the subnormals.
double Scale(double x, int n) {
  if (n > 1023) return x * FromBits(uint64_t{2046} << 52) * FromBits(static_cast<uint64_t>(n - 1023 + 1023) << 52);
  if (n >= -1022) return x * FromBits(static_cast<uint64_t>(n + 1023) << 52);
  if (n < -1100) n = -1100;
  return x * FromBits(uint64_t{1} << 52) * FromBits(static_cast<uint64_t>(n + 1022 + 1023) << 52);
}

// Taylor series on [-pi/4, pi/4] of the sum x.high + x.low.
double SinKernel(Pair x) {
  const double z = x.high * x.high;
  double r = 1.0 / 355687428096000.0;
  r = r * z - 1.0 / 1307674368000.0;
  r = r * z + 1.0 / 6227020800.0;
  r = r * z - 1.0 / 39916800.0;
  r = r * z + 1.0 / 362880.0;
  r = r * z - 1.0 / 5040.0;
  r = r * z + 1.0 / 120.0;
  r = r * z - 1.0 / 6.0;
  return x.high + (x.high * z * r + x.low * (1 - 0.5 * z));
}
double CosKernel(Pair x) {
  const double z = x.high * x.high;
  double r = -1.0 / 6402373705728000.0;
  r = r * z + 1.0 / 20922789888000.0;
  r = r * z - 1.0 / 87178291200.0;
  r = r * z + 1.0 / 479001600.0;
  r = r * z - 1.0 / 3628800.0;
  r = r * z + 1.0 / 40320.0;
  r = r * z - 1.0 / 720.0;
  r = r * z + 1.0 / 24.0;
  const double half = 0.5 * z, w = 1 - half;
  return w + (((1 - w) - half) + (z * z * r - x.high * x.low));
}

// Bits of 2/pi after the binary point.
constexpr uint64_t kTwoOverPi[] = {0xa2f9836e4e441529, 0xfc2757d1f534ddc0, 0xdb6295993c439041, 0xfe5163abdebbc561,
                                   0xb7246e3a424dd2e0, 0x06492eea09d1921c, 0xfe1deb1cb129a73e, 0xe88235f52ebb4484,
                                   0xe99c7026b45f7e41, 0x3991d639835339f4, 0x9c845f8bbdf9283b, 0x1ff897ffde05980f,
                                   0xef2f118b5a0a6d1f, 0x6d367ecf27cb09b7, 0x4f463f669e5fea2d, 0x7527bac7ebe5f17b,
                                   0x3d0739f78a5292ea, 0x6bfb5fb11f8d5d08, 0x56033046fc7b6bab, 0xf0cfbc209af4361d};

// 64 bits of 2/pi from bit `from` on; bits before the point are zero.
uint64_t TwoOverPiBits(int from) {
  if (from <= -64) return 0;
  if (from < 0) return kTwoOverPi[0] >> -from;
  const int word = from / 64, shift = from % 64;
  return shift == 0 ? kTwoOverPi[word] : (kTwoOverPi[word] << shift) | (kTwoOverPi[word + 1] >> (64 - shift));
}

// x = n pi/2 + rest for large |x| (Payne and Hanek): x is m 2^e, and of m 2^e (2/pi) only the bits below 4 matter.
int ReduceLarge(double x, Pair* rest) {
  const uint64_t bits = Bits(x);
  const int e = static_cast<int>((bits >> 52) & 0x7ff) - 1075;
  const uint64_t m = (bits & 0xfffffffffffff) | 0x10000000000000;
  // Three words of 2/pi times 2^e whose top two bits weigh 2 and 1.
  const int first = e - 2;
  const uint64_t w0 = TwoOverPiBits(first), w1 = TwoOverPiBits(first + 64), w2 = TwoOverPiBits(first + 128);
  const Wide low = static_cast<Wide>(m) * w2;
  const Wide middle = static_cast<Wide>(m) * w1 + static_cast<uint64_t>(low >> 64);
  const uint64_t p1 = static_cast<uint64_t>(middle), p0 = m * w0 + static_cast<uint64_t>(middle >> 64);
  int n = static_cast<int>(p0 >> 62);
  Wide fraction = (static_cast<Wide>(p0) << 66) | (static_cast<Wide>(p1) << 2) | (static_cast<uint64_t>(low) >> 62);
  bool negative = false;
  if (fraction >> 127 != 0) {  // nearer to the next multiple
    fraction = -fraction;
    negative = true;
    n = (n + 1) & 3;
  }
  double scale = 1;  // keeps the leading bits when x is close to a multiple
  for (; fraction != 0 && fraction >> 126 == 0; fraction <<= 1) scale *= 0.5;
  const double high = static_cast<double>(static_cast<uint64_t>(fraction >> 75)) * 0x1p-53 * scale;
  const Wide tail = fraction & ((static_cast<Wide>(1) << 75) - 1);
  const double lower = static_cast<double>(static_cast<uint64_t>(tail >> 22)) * 0x1p-106 * scale;
  Pair r = Product(FastSum(high, lower), Pair{kHalfPi, kHalfPiLow});
  if (negative) r = {-r.high, -r.low};
  if (Negative(x)) {
    r = {-r.high, -r.low};
    n = -n & 3;
  }
  *rest = r;
  return n;
}

// x = n pi/2 + rest, |rest| <= pi/4; returns n modulo 4 (Cody and Waite).
int Reduce(double x, Pair* rest) {
  if (Magnitude(x) <= kHalfPi / 2) {
    *rest = {x, 0};
    return 0;
  }
  if (Magnitude(x) > 0x1p19) return ReduceLarge(x, rest);
  constexpr double kPart1 = 0x1.921fb544p+0, kPart2 = 0x1.0b4611a6p-34, kPart3 = 0x1.3198a2ep-69;
  constexpr double kPart4 = 0x1.b839a252049c1p-104;
  const int64_t n = static_cast<int64_t>(x * 0x1.45f306dc9c883p-1 + (x < 0 ? -0.5 : 0.5));
  const double k = static_cast<double>(n);
  const Pair a = Sum(x - k * kPart1, -(k * kPart2));  // both products are exact: 33 and 20 bits
  const Pair b = Sum(a.high, -(k * kPart3));
  *rest = FastSum(b.high, b.low + (a.low - k * kPart4));
  return static_cast<int>(n & 3);
}

double Sine(double x) {
  if (IsNan(x) || IsInfinite(x)) return NotANumber();
  Pair r;
  switch (Reduce(x, &r)) {
    case 0:
      return SinKernel(r);
    case 1:
      return CosKernel(r);
    case 2:
      return -SinKernel(r);
    default:
      return -CosKernel(r);
  }
}
double Cosine(double x) {
  if (IsNan(x) || IsInfinite(x)) return NotANumber();
  Pair r;
  switch (Reduce(x, &r)) {
    case 0:
      return CosKernel(r);
    case 1:
      return -SinKernel(r);
    case 2:
      return -CosKernel(r);
    default:
      return SinKernel(r);
  }
}

// ln 2 with a first part short enough for exact products with exponents.
constexpr double kLn2High = 0x1.62e42feep-1, kLn2Middle = 0x1.a39ef35793c76p-33, kLn2Low = 0x1.cc01f97b57a08p-87;

// ln x of a positive finite x: 2 atanh(s) with s = (m-1)/(m+1), m in [sqrt(1/2), sqrt(2)).
Pair LogPair(double x) {
  int e = 0;
  if (x < 0x1p-1022) {
    x *= 0x1p54;
    e = -54;
  }
  uint64_t b = Bits(x);
  e += static_cast<int>(b >> 52) - 1023;
  double m = FromBits((b & 0xfffffffffffff) | 0x3ff0000000000000);
  if (m > 1.4142135623730951) {
    m *= 0.5;
    ++e;
  }
  const double f = m - 1;  // exact
  const Pair g = Sum(m, 1.0);
  const double s = f / g.high;
  const Pair back = Product(s, g.high);
  const double correction = (((f - back.high) - back.low) - s * g.low) / g.high;
  const Pair u = FastSum(s, correction);
  const Pair z = Product(u, u);
  double r = 0;
  for (int k = 25; k >= 5; k -= 2) r = (r + 1.0 / k) * z.high;
  const Pair third = {0x1.5555555555555p-2, 0x1.5555555555555p-56};
  const Pair series = Product(Product(u, z), Sum(third, Pair{r, 0}));
  const Pair log_m = Sum(Pair{2 * u.high, 2 * u.low}, Pair{2 * series.high, 2 * series.low});
  const double k = e;
  const Pair middle = Product(k, kLn2Middle);
  return Sum(Sum(Pair{k * kLn2High, 0}, Pair{middle.high, middle.low + k * kLn2Low}), log_m);
}

// e^(x.high + x.low).
double ExpPair(Pair x) {
  if (x.high > 710) return Infinity();
  if (x.high < -760) return 0;
  const int n = static_cast<int>(x.high * 0x1.71547652b82fep+0 + (x.high < 0 ? -0.5 : 0.5));
  const double k = n;
  const Pair middle = Product(k, kLn2Middle);
  Pair r = Sum(Sum(x.high - k * kLn2High, -middle.high), Pair{x.low - middle.low - k * kLn2Low, 0});
  double tail = 0;  // r^5/5! + ...
  for (int i = 17; i >= 6; --i) tail = (tail + 1) * r.high / i;
  tail = (tail + 1) / 120;
  Pair p = Sum(Pair{0x1.5555555555555p-5, 0x1.5555555555555p-59}, Product(r, Pair{tail, 0}));
  p = Sum(Pair{0x1.5555555555555p-3, 0x1.5555555555555p-57}, Product(r, p));
  p = Sum(Pair{0.5, 0}, Product(r, p));
  p = Sum(Pair{1, 0}, Product(r, p));
  p = Sum(Pair{1, 0}, Product(r, p));
  return Scale(p.high + p.low, n);
}

// Arc tangent of q.high + q.low in [0, 1].
Pair AtanPair(Pair q) {
  struct Anchor {
    double x;
    Pair atan;
  };
  static constexpr Anchor kAnchors[] = {{0, {0, 0}},
                                        {0.25, {0x1.f5b75f92c80ddp-3, 0x1.8ab6e3cf7afbdp-57}},
                                        {0.5, {0x1.dac670561bb4fp-2, 0x1.a2b7f222f65e2p-56}},
                                        {0.75, {0x1.4978fa3269ee1p-1, 0x1.2419a87f2a458p-56}},
                                        {1, {0x1.921fb54442d18p-1, 0x1.1a62633145c07p-55}}};
  const Anchor& c = kAnchors[static_cast<int>(q.high * 4 + 0.5)];
  // atan q = atan c + atan t, t = (q - c) / (1 + q c), |t| <= 1/8
  const double t = ((q.high - c.x) + q.low) / (1 + q.high * c.x);
  const double z = t * t;
  double r = 0;
  for (int k = 19; k >= 3; k -= 2) r = z * (((k >> 1) % 2 != 0 ? -1.0 / k : 1.0 / k) + r);
  return Sum(c.atan, FastSum(t, c.x == 0 && q.high == t ? t * r + q.low : t * r));
}

double Atan2(double y, double x) {
  if (IsNan(x) || IsNan(y)) return NotANumber();
  const double ay = Magnitude(y), ax = Magnitude(x);
  Pair a;
  if (ay == 0) {
    a = {0, 0};
  } else if (IsInfinite(ay) && IsInfinite(ax)) {
    a = {kHalfPi / 2, kHalfPiLow / 2};
  } else if (ay <= ax) {
    a = AtanPair({ay / ax, 0});
  } else {
    a = AtanPair({ax / ay, 0});
    a = Sum(Pair{kHalfPi, kHalfPiLow}, Pair{-a.high, -a.low});
  }
  if (Negative(x)) a = Sum(Pair{kPi, kPiLow}, Pair{-a.high, -a.low});
  const double angle = a.high + a.low;
  return Negative(y) ? -angle : angle;
}

// Whether y is an odd integer; *integer: any integer.
bool OddInteger(double y, bool* integer) {
  const double a = Magnitude(y);
  *integer = true;
  if (a >= 0x1p53) return false;
  const int64_t n = static_cast<int64_t>(a);
  *integer = static_cast<double>(n) == a;
  return *integer && (n & 1) != 0;
}

double Power(double x, double y) {
  if (y == 0 || x == 1) return 1;
  if (IsNan(x) || IsNan(y)) return NotANumber();
  bool integer = false;
  const bool odd = OddInteger(y, &integer);
  const double ax = Magnitude(x);
  const double sign = Negative(x) && odd ? -1 : 1;
  if (IsInfinite(y)) return ax == 1 ? 1 : (ax > 1) == (y > 0) ? Infinity() : 0;
  if (ax == 0) return y > 0 ? sign * 0.0 : sign * Infinity();
  if (IsInfinite(ax)) return y > 0 ? sign * Infinity() : sign * 0.0;
  if (Negative(x) && !integer) return NotANumber();
  if (ax == 1) return sign;
  const Pair l = LogPair(ax);
  if (Magnitude(y * l.high) > 800) return sign * (y * l.high > 0 ? Infinity() : 0.0);
  if (Magnitude(y) < 0x1p-900) return sign;
  return sign * ExpPair(Product(l, Pair{y, 0}));
}

}  // namespace

int DeterministicMathVersion() { return 1; }

}  // namespace aureole

#pragma GCC visibility push(default)
extern "C" {
double sin(double x) { return aureole::Sine(x); }
double cos(double x) { return aureole::Cosine(x); }
void sincos(double x, double* s, double* c) {
  *s = aureole::Sine(x);
  *c = aureole::Cosine(x);
}
double pow(double x, double y) { return aureole::Power(x, y); }
double exp(double x) { return x != x ? x : aureole::ExpPair({x, 0}); }
double log(double x) {
  if (x == 0) return -aureole::Infinity();
  if (!(x > 0)) return aureole::NotANumber();
  if (aureole::IsInfinite(x)) return x;
  const aureole::Pair l = aureole::LogPair(x);
  return l.high + l.low;
}
double atan2(double y, double x) { return aureole::Atan2(y, x); }
double atan(double x) { return aureole::Atan2(x, 1); }
double asin(double x) {
  return x >= -1 && x <= 1 ? aureole::Atan2(x, aureole::Sqrt((1 - x) * (1 + x))) : aureole::NotANumber();
}
double acos(double x) {
  return x >= -1 && x <= 1 ? 2 * aureole::Atan2(aureole::Sqrt(1 - x), aureole::Sqrt(1 + x)) : aureole::NotANumber();
}
}
#pragma GCC visibility pop
