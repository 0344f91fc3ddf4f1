
// Operations as JAX defines them: extremes propagate NaN, and signs keep zeros; of integers, division by zero gives -1,
// with the dividend as remainder. Floats become integers towards zero, saturated; NaN gives 0.

#define ORDERED(type)                                                                           \
  SELECT(type)                                                                                  \
  ONE type max_##type(type a, type b) { return select_##type(MASK((a > b) | (a != a)), b, a); } \
  ONE type min_##type(type a, type b) { return select_##type(MASK((a < b) | (a != a)), b, a); } \
  ONE type sign_##type(type x) {                                                                \
    type one = select_##type(MASK(x > 0), ALL(type, (LANE(type))-1), ALL(type, 1));             \
    return select_##type(MASK((x > 0) | (x < 0)), x, one);                                      \
  }
ORDERED(f64)
ORDERED(f32)

#define INTEGERS(type, least, most)                                                                    \
  ORDERED(type)                                                                                        \
  ONE LANE(type) lane_div_##type(LANE(type) x, LANE(type) y) {                                         \
    return !y ? -1 : y == (LANE(type))-1 && (LANE(type))-1 < 0 ? -x : x / y;                           \
  }                                                                                                    \
  ONE LANE(type) lane_rem_##type(LANE(type) x, LANE(type) y) {                                         \
    return !y ? x : y == (LANE(type))-1 && (LANE(type))-1 < 0 ? 0 : x % y;                             \
  }                                                                                                    \
  ONE LANE(type) lane_of_##type(double x) {                                                            \
    return x >= (double)(most) ? (most) : x <= (double)(least) ? (least) : x != x ? 0 : (LANE(type))x; \
  }                                                                                                    \
  BINARY(type, div, lane_div_##type)                                                                   \
  BINARY(type, rem, lane_rem_##type)                                                                   \
  ROUNDED(type)                                                                                        \
  ONE type type##_of_f32(f32 x) { return type##_of_f64(AS(f64, x)); }
INTEGERS(i64, -9223372036854775807LL - 1, 9223372036854775807LL)
INTEGERS(i32, -2147483647 - 1, 2147483647)
INTEGERS(i16, -32768, 32767)
INTEGERS(i8, -128, 127)
INTEGERS(u64, 0, 18446744073709551615ULL)
INTEGERS(u32, 0, 4294967295U)
INTEGERS(u16, 0, 65535)
INTEGERS(u8, 0, 255)

// Functions of floats from the library of C or CUDA, as either prelude defines `FUNCTION` and `BINARY`.

// A power of 1 or 2, as most contacts have it, costs no call.
ONE double power(double x, double y) { return y == 2 ? x * x : y == 1 ? x : pow(x, y); }
ONE float powerf(float x, float y) { return y == 2 ? x * x : y == 1 ? x : powf(x, y); }

FUNCTION(acos)
FUNCTION(asin)
FUNCTION(atan)
EACH_LANE(ceil)
FUNCTION(cos)
FUNCTION(cosh)
FUNCTION(erf)
FUNCTION(exp)
FUNCTION(expm1)
EACH_LANE(floor)
FUNCTION(log)
FUNCTION(log1p)
EACH_LANE(rint)
EACH_LANE(round)
FUNCTION(sin)
FUNCTION(sinh)
FUNCTION(tan)
FUNCTION(tanh)
BINARY(f64, atan2, atan2)
BINARY(f32, atan2, atan2f)
BINARY(f64, pow, power)
BINARY(f32, pow, powerf)
BINARY(f64, rem, fmod)
BINARY(f32, rem, fmodf)
