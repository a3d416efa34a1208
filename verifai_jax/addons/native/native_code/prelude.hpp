/* The beginning of every translated program: vector types, and mathematics on them.
   All of it obeys IEEE 754, so that NaN and infinities arise and spread as in XLA's programs. */
#if defined(__AVX512F__)
#define W 16
#elif defined(__AVX__)
#define W 8
#else
#define W 4
#endif
typedef float F __attribute__((vector_size(4 * W)));
typedef int I __attribute__((vector_size(4 * W)));
typedef unsigned U __attribute__((vector_size(4 * W)));
#define INLINE static inline __attribute__((always_inline))
#define OUTLINE static __attribute__((noinline, unused))
#define REPEAT for (int k = 0; k < K; k++)
#define EACH(expression) F r; for (int l = 0; l < W; l++) r[l] = expression; return r;

INLINE F wide(float x) { return x - (F){}; }
INLINE I wide(int x) { return x - (I){}; }
INLINE U wide(unsigned x) { return x - (U){}; }
INLINE F wide(F x) { return x; }
INLINE I wide(I x) { return x; }
INLINE U wide(U x) { return x; }

INLINE U to_bits(F x) { return (U)x; }
INLINE U to_bits(I x) { return (U)x; }
INLINE U to_bits(U x) { return x; }
INLINE unsigned to_bits(float x) { unsigned r; __builtin_memcpy(&r, &x, 4); return r; }
INLINE unsigned to_bits(int x) { return (unsigned)x; }
INLINE unsigned to_bits(unsigned x) { return x; }
INLINE F real_bits(U x) { return (F)x; }
INLINE F real_bits(I x) { return (F)x; }
INLINE float real_bits(unsigned x) { float r; __builtin_memcpy(&r, &x, 4); return r; }
INLINE float real_bits(int x) { return real_bits((unsigned)x); }
INLINE I whole_bits(U x) { return (I)x; }
INLINE I whole_bits(F x) { return (I)x; }
INLINE int whole_bits(unsigned x) { return (int)x; }
INLINE int whole_bits(float x) { return (int)to_bits(x); }

/* Truth values are -1 and 0, of vectors as of single ones. */
INLINE I truth(I x) { return x; }
INLINE int truth(bool x) { return -(int)x; }
INLINE F choose(I p, F a, F b) { return p ? a : b; }
INLINE I choose(I p, I a, I b) { return p ? a : b; }
INLINE U choose(I p, U a, U b) { return p ? a : b; }
template <class T> INLINE T choose(int p, T a, T b) { return p ? a : b; }
#if defined(__AVX512F__)
INLINE bool any(I p) { return __builtin_ia32_ptestmd512(p, p, (unsigned short)-1) != 0; }
#else
INLINE bool any(I p) { int r = 0; for (int l = 0; l < W; l++) r |= p[l]; return r != 0; }
#endif

INLINE F to_real(I x) { return __builtin_convertvector(x, F); }
INLINE F to_real(U x) { return __builtin_convertvector(x, F); }
INLINE float to_real(int x) { return (float)x; }
INLINE float to_real(unsigned x) { return (float)x; }
INLINE I truncated(F x) { return __builtin_convertvector(x, I); }
INLINE int truncated(float x) { return (int)x; }
INLINE I filled(F, int x) { return wide(x); }
INLINE int filled(float, int x) { return x; }
INLINE F filled(F, float x) { return wide(x); }
INLINE float filled(float, float x) { return x; }
template <class T> INLINE auto saturated(T x) -> decltype(truncated(x)) {
  /* What is too small is the smallest number already, on x86; elsewhere all of it is as here. */
  auto r = choose(truth(x >= 2147483648.f), filled(x, 2147483647), truncated(x));
  return choose(truth(x != x), filled(x, 0), r);
}
INLINE int to_whole(float x) { return saturated(x); }
#if defined(__AVX512F__)
OUTLINE I saturated_seldom(F x) { return saturated(x); }
INLINE I to_whole(F x) {
  I r = truncated(x), lowest = wide(-2147483647 - 1);
  bool beyond = __builtin_ia32_cmpd512_mask(r, lowest, 0, (unsigned short)-1) != 0;
  return __builtin_expect(beyond, 0) ? saturated_seldom(x) : r; }
#else
INLINE I to_whole(F x) { return saturated(x); }
#endif
INLINE U to_natural(F x) { U r; for (int l = 0; l < W; l++)
  r[l] = x[l] > 0 ? (x[l] < 4294967296.f ? (unsigned)x[l] : 4294967295u) : 0u; return r; }
INLINE unsigned to_natural(float x) {
  return x > 0 ? (x < 4294967296.f ? (unsigned)x : 4294967295u) : 0u; }

template <class T> INLINE T greater(T a, T b) { T m = choose(truth(a > b), a, b);
  return choose(truth(a != a), a, m); }
template <class T> INLINE T lesser(T a, T b) { T m = choose(truth(a < b), a, b);
  return choose(truth(a != a), a, m); }
/* The same where the first one is no NaN. */
template <class T> INLINE T greater_than_bound(T bound, T x) { return greater(bound, x); }
template <class T> INLINE T lesser_than_bound(T bound, T x) { return lesser(bound, x); }
/* Instructions that do the same, where a compiler does not find them: they give b for NaN. */
#if defined(__AVX512F__) && defined(__clang__)
#define EXTREME(which, a, b) __builtin_ia32_##which##ps512(a, b, 4)
#elif defined(__AVX512F__)
#define EXTREME(which, a, b) __builtin_ia32_##which##ps512_mask(a, b, a, (unsigned short)-1, 4)
#elif defined(__AVX__)
#define EXTREME(which, a, b) __builtin_ia32_##which##ps256(a, b)
#endif
#if defined(__AVX512F__) && !defined(__clang__)
#define EXTREME_OR_NAN(which, a, b) __builtin_ia32_##which##ps512_mask(a, b, a, \
  __builtin_ia32_cmpps512_mask(a, a, 7, (unsigned short)-1, 4), 4)
#elif defined(EXTREME)
#define EXTREME_OR_NAN(which, a, b) choose(a != a, a, EXTREME(which, a, b))
#endif
#if defined(EXTREME)
INLINE F greater(F a, F b) { return EXTREME_OR_NAN(max, a, b); }
INLINE F lesser(F a, F b) { return EXTREME_OR_NAN(min, a, b); }
INLINE F greater_than_bound(F bound, F x) { return EXTREME(max, bound, x); }
INLINE F lesser_than_bound(F bound, F x) { return EXTREME(min, bound, x); }
#endif
INLINE F absolute(F x) { return (F)((U)x & 0x7fffffffu); }
INLINE float absolute(float x) { return __builtin_fabsf(x); }
INLINE I absolute(I x) { return choose(x < 0, -x, x); }
INLINE int absolute(int x) { return x < 0 ? (int)(0u - (unsigned)x) : x; }
template <class T> INLINE T with_sign(T x, T s) {
  return real_bits((to_bits(x) & 0x7fffffffu) | (to_bits(s) & 0x80000000u)); }
template <class T> INLINE auto finite(T x) -> decltype(truth(x == x)) {
  return truth((to_bits(x) & 0x7f800000u) != 0x7f800000u); }
/* Whole numbers in the order of real ones, in which -0 is below 0 and NaN above all. */
template <class T> INLINE auto in_order(T x) -> decltype(whole_bits(x)) {
  auto bits = whole_bits(x); return choose(truth(bits < 0), bits ^ 0x7fffffff, bits); }
template <class T> INLINE T sign_of(T x) {
  T one = with_sign(filled(x, 1.f), x);
  return choose(truth(x == 0.f) | truth(x != x), x, one); }
INLINE I sign_of(I x) { return (x > 0 ? wide(1) : wide(0)) + (x < 0 ? wide(-1) : wide(0)); }
INLINE int sign_of(int x) { return (x > 0) - (x < 0); }

template <class T> INLINE T nearest(T x) {
  T a = absolute(x), r = (a + 8388608.f) - 8388608.f;
  return choose(truth(a < 8388608.f), with_sign(r, x), x); }
template <class T> INLINE T rounded_down(T x) { T r = nearest(x);
  return choose(truth(r > x), r - 1.f, r); }
template <class T> INLINE T rounded_up(T x) { T r = nearest(x);
  return with_sign(choose(truth(r < x), r + 1.f, r), x); }
#if defined(__AVX512F__)
#define ROUNDED(x, how) __builtin_ia32_rndscaleps_mask(x, how, x, (unsigned short)-1, 4)
#elif defined(__AVX__)
#define ROUNDED(x, how) __builtin_ia32_roundps256(x, how)
#endif
#if defined(ROUNDED)
INLINE F nearest(F x) { return ROUNDED(x, 8); }
INLINE F rounded_down(F x) { return ROUNDED(x, 9); }
INLINE F rounded_up(F x) { return ROUNDED(x, 10); }
#endif
template <class T> INLINE T rounded_away(T x) {
  T a = absolute(x), r = rounded_down(a);
  r = choose(truth(a - r >= 0.5f), r + 1.f, r);
  return choose(truth(a < 8388608.f), with_sign(r, x), x); }
/* x / y of ordinary numbers; where an instruction estimates reciprocals it is refined instead, which
   takes a third of the time. */
#if defined(__AVX512F__)
INLINE F ordinary_ratio(F x, F y) {
  F r = __builtin_ia32_rcp14ps512_mask(y, F(), (unsigned short)-1);
  r = r + r * (1.f - y * r);
  F q = x * r; return q + (x - q * y) * r; }
/* x / y rounded as the division is, but for numbers near the largest. It takes no longer than the
   additions that would wait for many divisions. */
INLINE F ratio(F x, F y) {
  F r = __builtin_ia32_rcp14ps512_mask(y, F(), (unsigned short)-1), e = 1.f - y * r;
  if (__builtin_expect(any(~(e < 0.5f)), 0)) return x / y;
  r = r + r * e;
  F q = x * r, better = q + (x - q * y) * r;
  return choose(better == better, better, q); }
#else
INLINE F ordinary_ratio(F x, F y) { return x / y; }
INLINE F ratio(F x, F y) { return x / y; }
#endif
INLINE float ordinary_ratio(float x, float y) { return x / y; }
/* x / y with the reciprocal of y: rounded as the division is, but for numbers near the largest. */
INLINE F divided(F x, F y, F reciprocal) {
  F q = x * reciprocal, better = q + (x - q * y) * reciprocal;
#if defined(__AVX512F__) && !defined(__clang__)
  /* Where q is NaN, infinite or zero it is the result: four bits for each kind of number. */
  return __builtin_ia32_fixupimmps512_mask(
    better, q, wide(0x00110111), 0, (unsigned short)-1, 4);
#else
  return choose(better == better, better, q);
#endif
}
INLINE float root(float x) { return __builtin_sqrtf(x); }
INLINE F root(F x) {
  F r; float *to = (float *)&r; const float *from = (const float *)&x;
  for (int l = 0; l < W; l++) to[l] = __builtin_sqrtf(from[l]);
  return r; }

/* 2^n for -252 <= n <= 254, in two factors, since one of them alone would overflow. */
template <class T, class N> INLINE T scaled(T x, N n) {
  N half = n >> 1, rest = n - half;
  return x * real_bits((half + 127) << 23) * real_bits((rest + 127) << 23); }
template <class T> INLINE T exponential(T x) {
  T c = choose(truth(x > 89.f), filled(x, 89.f), x);
  c = choose(truth(c < -104.f), filled(x, -104.f), c);
  T n = nearest(c * 1.44269504088896341f);
  T r = c - n * 0.693359375f; r = r - n * -2.12194440e-4f;
  T p = filled(x, 1.9875691500e-4f);
  p = p * r + 1.3981999507e-3f; p = p * r + 8.3334519073e-3f; p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f; p = p * r + 5.0000001201e-1f;
  p = p * (r * r) + r + 1.f;
  T y = scaled(p, truncated(choose(truth(n == n), n, filled(x, 0.f))));
  return choose(truth(x != x), x, y); }
template <class T> INLINE T logarithm(T x) {
  auto tiny = truth(x < 1.17549435e-38f);
  T s = choose(tiny, x * 8388608.f, x);
  auto b = to_bits(s);
  T e = to_real(whole_bits(b >> 23) - 126) - choose(tiny, filled(x, 23.f), filled(x, 0.f));
  T m = real_bits((b & 0x007fffffu) | 0x3f000000u);
  auto low = truth(m < 0.707106781186547524f);
  e = e - choose(low, filled(x, 1.f), filled(x, 0.f));
  m = m - 1.f + choose(low, m, filled(x, 0.f));
  T z = m * m, p = filled(x, 7.0376836292e-2f);
  p = p * m - 1.1514610310e-1f; p = p * m + 1.1676998740e-1f; p = p * m - 1.2420140846e-1f;
  p = p * m + 1.4249322787e-1f; p = p * m - 1.6668057665e-1f; p = p * m + 2.0000714765e-1f;
  p = p * m - 2.4999993993e-1f; p = p * m + 3.3333331174e-1f;
  T y = p * m * z + e * -2.12194440e-4f - 0.5f * z;
  y = m + y + e * 0.693359375f;
  y = choose(truth(x == __builtin_inff()), x, y);
  y = choose(truth(x == 0.f), filled(x, -__builtin_inff()), y);
  return choose(truth(x >= 0.f), y, filled(x, __builtin_nanf(""))); }
template <class T> INLINE T logarithm1(T x) {
  T u = 1.f + x, d = u - 1.f;
  T y = logarithm(u) * (x / choose(truth(d == 0.f), filled(x, 1.f), d));
  return choose(truth(d == 0.f), x, choose(truth(u == __builtin_inff()), u, y)); }
template <class T> INLINE T exponential1(T x) {
  T r = x * 0.5f, z = x * x;
  T p = x + z * 0.5f + z * x * (1.6666667e-1f + x * (4.1666668e-2f + x * (8.3333338e-3f
    + x * (1.3888889e-3f + x * 1.984127e-4f))));
  T e = exponential(r);
  return choose(truth(absolute(x) < 0.35f), p, choose(truth(x > 88.f) , exponential(x),
    e * e - 1.f)); }
template <class T> INLINE T hyperbolic(T x) {
  T end = filled(x, 7.90531110763549805f), c = greater_than_bound(-end, lesser_than_bound(end, x));
  T s = c * c, p = filled(x, -2.76076847742355e-16f), q = filled(x, 1.19825839466702e-06f);
  p = p * s + 2.00018790482477e-13f; p = p * s - 8.60467152213735e-11f;
  p = p * s + 5.12229709037114e-08f; p = p * s + 1.48572235717979e-05f;
  p = p * s + 6.37261928875436e-04f; p = p * s + 4.89352455891786e-03f;
  q = q * s + 1.18534705686654e-04f; q = q * s + 2.26843463243900e-03f;
  q = q * s + 4.89352518554385e-03f;
  return ordinary_ratio(c * p, q); }
template <class T> INLINE T inverse_error(T x) {
  T w = -logarithm1(-x * x), a = w - 2.5f, b = root(w) - 3.f;
  T p = filled(x, 2.81022636e-08f), q = filled(x, -0.000200214257f);
  p = p * a + 3.43273939e-07f; p = p * a - 3.5233877e-06f; p = p * a - 4.39150654e-06f;
  p = p * a + 0.00021858087f; p = p * a - 0.00125372503f; p = p * a - 0.00417768164f;
  p = p * a + 0.246640727f; p = p * a + 1.50140941f;
  q = q * b + 0.000100950558f; q = q * b + 0.00134934322f; q = q * b - 0.00367342844f;
  q = q * b + 0.00573950773f; q = q * b - 0.0076224613f; q = q * b + 0.00943887047f;
  q = q * b + 1.00167406f; q = q * b + 2.83297682f;
  T y = choose(truth(w < 5.f), p, q) * x;
  return choose(truth(absolute(x) == 1.f), x * __builtin_inff(), y); }

/* Functions of single numbers from the C library, number by number. */
#define FROM_LIBRARY(name, call) \
  INLINE float name(float x) { return call(x); } \
  OUTLINE F name(F x) { EACH(call(x[l])) }
FROM_LIBRARY(library_tangent, __builtin_tanf)
FROM_LIBRARY(arcsine, __builtin_asinf)
FROM_LIBRARY(arccosine, __builtin_acosf)
FROM_LIBRARY(sine_h, __builtin_sinhf)
FROM_LIBRARY(cosine_h, __builtin_coshf)
FROM_LIBRARY(arcsine_h, __builtin_asinhf)
FROM_LIBRARY(arccosine_h, __builtin_acoshf)
FROM_LIBRARY(arctangent_h, __builtin_atanhf)
FROM_LIBRARY(cube_root, __builtin_cbrtf)
FROM_LIBRARY(error_function, __builtin_erff)
FROM_LIBRARY(error_rest, __builtin_erfcf)
FROM_LIBRARY(library_sine, __builtin_sinf)
FROM_LIBRARY(library_cosine, __builtin_cosf)
#define FROM_LIBRARY_2(name, call) \
  INLINE float name(float x, float y) { return call(x, y); } \
  OUTLINE F name(F x, F y) { EACH(call(x[l], y[l])) }
FROM_LIBRARY_2(library_power, __builtin_powf)
FROM_LIBRARY_2(remainder_of, __builtin_fmodf)
FROM_LIBRARY_2(next_number, __builtin_nextafterf)

template <class T> INLINE T arctangent(T x) {
  T a = absolute(x);
  auto far = truth(a > 2.414213562373095f), middle = truth(a > 0.4142135623730950f);
  T y = choose(far, filled(x, 1.5707963267948966f),
    choose(middle, filled(x, 0.7853981633974483f), filled(x, 0.f)));
  T one = filled(x, 1.f), z = choose(far, -one, choose(middle, a - 1.f, a));
  z = z / choose(far, a, choose(middle, a + 1.f, one));
  T s = z * z;
  T p = s * 8.05374449538e-2f - 1.38776856032e-1f;
  p = p * s + 1.99777106478e-1f; p = p * s - 3.33329491539e-1f;
  return with_sign(y + (p * s * z + z), x); }
template <class T> INLINE T angle(T y, T x) {
  T pi = filled(x, 3.14159265358979f), zero = filled(x, 0.f);
  auto left = truth(whole_bits(to_bits(x)) < 0);
  auto both = truth(absolute(x) == __builtin_inff()) & truth(absolute(y) == __builtin_inff());
  T q = choose(both, filled(x, 1.f), absolute(y) / absolute(x));
  q = choose(truth(y == 0.f) & truth(x == x), zero, arctangent(q));
  return choose(truth(x != x) | truth(y != y), x + y, with_sign(choose(left, pi - q, q), y)); }

/* Sine and cosine: reduced by pi/2 in three parts, as exactly as single precision allows. */
template <class T> INLINE void sine_cosine(T x, T *s, T *c) {
  T n = nearest(x * 0.636619772367581343f);
  T r = ((x - n * 1.5703125f) - n * 4.837512969970703125e-4f) - n * 7.549790126404332e-8f;
  auto q = truncated(choose(truth(absolute(x) < 50000.f), n, filled(x, 0.f)));
  T z = r * r;
  T a = ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * r + r;
  T b = ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f)
    * z * z - 0.5f * z + 1.f;
  auto odd = truth((q & 1) != 0);
  T u = choose(odd, b, a), v = choose(odd, a, b);
  *s = choose(truth((q & 2) != 0), -u, u);
  *c = choose(truth(((q + 1) & 2) != 0), -v, v); }
INLINE bool beyond(F x) { return any(!(absolute(x) < 50000.f)); }
INLINE bool beyond(float x) { return !(absolute(x) < 50000.f); }
template <class T> INLINE T sine(T x) {
  T s, c; sine_cosine(x, &s, &c); return __builtin_expect(beyond(x), 0) ? library_sine(x) : s; }
template <class T> INLINE T cosine(T x) {
  T s, c; sine_cosine(x, &s, &c); return __builtin_expect(beyond(x), 0) ? library_cosine(x) : c; }
template <class T> INLINE T tangent(T x) {
  T s, c; sine_cosine(x, &s, &c);
  return __builtin_expect(beyond(x), 0) ? library_tangent(x) : s / c; }

/* Powers of positive numbers, in double precision. */
typedef double D __attribute__((vector_size(4 * W)));
typedef long long L __attribute__((vector_size(4 * W)));
typedef float H __attribute__((vector_size(2 * W)));
INLINE H half_power(H base, H exponent) {
  D x = __builtin_convertvector(base, D), y = __builtin_convertvector(exponent, D);
  L e = ((L)x >> 52) - 1023;
  D m = (D)(((L)x & 0x000fffffffffffffLL) | 0x3ff0000000000000LL);
  L big = m > 1.4142135623730951;
  m = big ? m * 0.5 : m; e = big ? e + 1 : e;
  /* A whole number as the mantissa of a large one: no instruction converts it everywhere. */
  D n = (D)(e + 0x4338000000000000LL) - 6755399441055744.0;
  D t = (m - 1.0) / (m + 1.0), s = t * t, p = s * (1.0 / 15) + 1.0 / 13;
  p = p * s + 1.0 / 11; p = p * s + 1.0 / 9; p = p * s + 1.0 / 7; p = p * s + 1.0 / 5;
  p = p * s + 1.0 / 3; p = p * s + 1.0;
  D z = y * (2.0 * t * p + n * 0.6931471805599453);
  z = z > 700.0 ? z - z + 700.0 : z; z = z < -700.0 ? z - z - 700.0 : z;
  D shifted = z * 1.4426950408889634 + 6755399441055744.0;
  D r = z - (shifted - 6755399441055744.0) * 0.6931471805599453;
  D q = r * (1.0 / 362880) + 1.0 / 40320;
  q = q * r + 1.0 / 5040; q = q * r + 1.0 / 720; q = q * r + 1.0 / 120; q = q * r + 1.0 / 24;
  q = q * r + 1.0 / 6; q = q * r + 0.5; q = q * r + 1.0; q = q * r + 1.0;
  q = q * (D)(((L)shifted - 0x4338000000000000LL + 1023) << 52);
  return __builtin_convertvector(q, H); }
INLINE float power(float x, float y) { return library_power(x, y); }
OUTLINE F power(F x, F y) {
  I plain = (x > 0.f) & finite(x) & finite(y);
  I nothing = (x == 0.f) & (y > 0.f) & ((I)x == 0), missing = (x != x) & (y != 0.f);
  if (any(~(plain | nothing | missing))) return library_power(x, y);
  F one = wide(1.f), safe = plain ? x : one, r;
  for (int h = 0; h < 2; h++) {
    H a, b;
    __builtin_memcpy(&a, (char *)&safe + h * sizeof(H), sizeof(H));
    __builtin_memcpy(&b, (char *)&y + h * sizeof(H), sizeof(H));
    a = half_power(a, b);
    __builtin_memcpy((char *)&r + h * sizeof(H), &a, sizeof(H));
  }
  return nothing ? F() : missing ? x : r; }

/* Elements of a table of n numbers, by a number for each simulation. */
INLINE F looked_up(const float *from, int n, I at) {
#if !defined(__clang__)
  if (n <= W) { F r = F(); __builtin_memcpy(&r, from, 4 * n); return __builtin_shuffle(r, at); }
#endif
  F r; for (int l = 0; l < W; l++) r[l] = from[at[l]]; return r; }
INLINE I looked_up(const int *from, int n, I at) {
  I r; for (int l = 0; l < W; l++) r[l] = from[at[l]]; return r; }
INLINE U looked_up(const unsigned *from, int n, I at) {
  U r; for (int l = 0; l < W; l++) r[l] = from[at[l]]; return r; }
#define FROM_MEMORY(V) INLINE V looked_up(const V (*from)[K], int k, I at) { \
  V r; for (int l = 0; l < W; l++) r[l] = from[at[l]][k][l]; return r; }
FROM_MEMORY(F) FROM_MEMORY(I) FROM_MEMORY(U)

INLINE int quotient(int a, int b) {
  return b == 0 ? -1 : b == -1 ? (int)(0u - (unsigned)a) : a / b; }
INLINE unsigned quotient(unsigned a, unsigned b) { return b == 0 ? ~0u : a / b; }
INLINE int residue(int a, int b) { return b == 0 ? a : b == -1 ? 0 : a % b; }
INLINE unsigned residue(unsigned a, unsigned b) { return b == 0 ? a : a % b; }
#define OF_WHOLES(name, V) \
  INLINE V name(V a, V b) { V r; for (int l = 0; l < W; l++) r[l] = name(a[l], b[l]); return r; }
OF_WHOLES(quotient, I) OF_WHOLES(quotient, U) OF_WHOLES(residue, I) OF_WHOLES(residue, U)

template <class T> INLINE T turned(T x, int n) { return (x << n) | (x >> (32 - n)); }
/* Threefry-2x32 of 20 rounds (Salmon et al., SC 2011). */
template <class T> INLINE void threefry(T a, T b, T x, T y, T *high, T *low) {
  T keys[3] = {a, b, a ^ b ^ 0x1BD11BDAu};
  static const int turns[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
  x = x + a; y = y + b;
  for (int i = 0; i < 5; i++) {
    for (int j = 0; j < 4; j++) { x = x + y; y = turned(y, turns[i % 2][j]) ^ x; }
    x = x + keys[(i + 1) % 3]; y = y + keys[(i + 2) % 3] + (unsigned)(i + 1);
  }
  *high = x; *low = y; }
