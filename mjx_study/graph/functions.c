
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
