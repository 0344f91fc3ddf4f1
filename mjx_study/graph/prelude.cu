// One sample per thread: the types and operations of prelude.c for a single lane.

#define ONE static __device__ __forceinline__
#define INFINITY __int_as_float(0x7f800000)
#define NAN __int_as_float(0x7fffffff)

typedef double f64;
typedef float f32;
typedef long long i64;
typedef int i32;
typedef short i16;
typedef signed char i8;
typedef unsigned long long u64;
typedef unsigned int u32;
typedef unsigned short u16;
typedef unsigned char u8;
typedef int mask;  // -1 or 0

#define AS(type, value) ((type)(value))
#define BITS(type, value) bits<type>(value)
#define MASK(comparison) (-(mask)(comparison))
#define ALL(type, constant) ((type)(constant))
#if LONG
#define PART static __device__ __noinline__
#define APART_IN_MEMORY 256  // what the samples of a warp keep alternates
#else
#define PART static __device__
#define APART_IN_MEMORY 8
#endif
#define ALL_PARTS static __device__
#define ARGUMENTS const struct batch &batch, const long lane, char *kept, long step
#define PASSED batch, lane, kept, step

ONE int any(mask m) { return m; }

template <typename to, typename from>
ONE to bits(from value) {
  union {
    from old;
    to same;
  } both = {value};
  return both.same;
}

#define SELECT(type) \
  ONE type select_##type(mask m, type no, type yes) { return m ? yes : no; }
ONE mask select_bool(mask m, mask no, mask yes) { return m ? yes : no; }

// Inputs and outputs: entry `at` of an array, for this sample. Booleans are bytes in memory.

#define PLACE_IN(place, at) (batch.shared[place] ? (at) : (at) * batch.count + lane)
#define LOAD(type, place, at) (((const type *)batch.in[place])[PLACE_IN(place, at)])
#define STORE(type, place, at, value) ((type *)batch.out[place])[(at) * batch.count + lane] = (value)
#define KEEP(type, slot, value) (*(type *)(kept + (slot) * APART_IN_MEMORY) = (value))
#define RECALL(type, slot) (*(const type *)(kept + (slot) * APART_IN_MEMORY))
#define ENTRY LOAD
#define LANE(type) type
#define CONSTANTS(type) static __device__ const type
#define TABLE(type, table, at) ((table)[at])
#define LOAD_BOOL(place, at) MASK(LOAD(u8, place, at) != 0)
#define STORE_BOOL(place, at, value) STORE(u8, place, at, (value) & 1)

// Operations of a lane.

#define UNARY(type, name, function) \
  ONE type name##_##type(type x) { return function(x); }
#define BINARY(type, name, function) \
  ONE type name##_##type(type x, type y) { return function(x, y); }
#define FUNCTION(name) UNARY(f64, name, name) UNARY(f32, name, name##f)
#define EACH_LANE FUNCTION
#define ROUNDED(type) \
  ONE type type##_of_f64(f64 x) { return lane_of_##type(x); }
UNARY(f64, abs, fabs)
UNARY(f32, abs, fabsf)
FUNCTION(sqrt)
