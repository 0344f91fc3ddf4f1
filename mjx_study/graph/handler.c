// Called by XLA with arrays of a whole batch, which is their fastest dimension; arrays without one are the same for all
// samples, and pass through `padded`. So do batches smaller than a vector, whose surplus lanes repeat the last sample; in
// others, the last vector ends with the last sample, and computes some of its samples again.

struct array {
  long entries, bytes, rank;
};
static const struct array IN[] = {INPUTS};
static const struct array OUT[] = {OUTPUTS};
#define NUM_IN (long)(sizeof(IN) / sizeof(IN[0]))
#define NUM_OUT (long)(sizeof(OUT) / sizeof(OUT[0]))

static void pad(char *to, const char *from, struct array form, long step, long left) {
  for (long at = 0; at < form.entries; at++)
    EACH memcpy(to + (at * LANES + lane) * form.bytes, from + at * step + (lane < left ? lane : left - 1) * form.bytes,
                form.bytes);
}

static void unpad(char *to, const char *from, struct array form, long step, long left) {
  for (long at = 0; at < form.entries; at++) memcpy(to + at * step, from + at * LANES * form.bytes, left * form.bytes);
}

static void batch(long count, const char *const *from, const int *shared, char *const *to) {
  static __thread char padded[LANES * BYTES + 1];
  static __thread char kept[VECTOR * KEPT + 1] __attribute__((aligned(VECTOR)));
  const char *in[NUM_IN];
  char *out[NUM_OUT], *spare[NUM_IN + NUM_OUT], *free = padded;
  long in_step[NUM_IN], out_step[NUM_OUT];
  for (long k = 0; k < NUM_IN; k++) spare[k] = free, free += LANES * IN[k].entries * IN[k].bytes;
  for (long k = 0; k < NUM_OUT; k++) spare[NUM_IN + k] = free, free += LANES * OUT[k].entries * OUT[k].bytes;
  for (long k = 0; k < NUM_IN; k++) {
    if (shared[k]) pad(spare[k], from[k], IN[k], IN[k].bytes, 1);
    in_step[k] = (shared[k] ? LANES : count) * IN[k].bytes;
  }
  int few = count < LANES;
  for (long k = 0; k < NUM_IN; k++)
    if (few && !shared[k]) {
      pad(spare[k], from[k], IN[k], in_step[k], count);
      in_step[k] = LANES * IN[k].bytes;
    }
  for (long k = 0; k < NUM_OUT; k++) out_step[k] = (few ? LANES : count) * OUT[k].bytes;
  for (long first = 0; first < count; first += LANES) {
    if (!few && first > count - LANES) first = count - LANES;
    for (long k = 0; k < NUM_IN; k++) in[k] = few || shared[k] ? spare[k] : from[k] + first * IN[k].bytes;
    for (long k = 0; k < NUM_OUT; k++) out[k] = few ? spare[NUM_IN + k] : to[k] + first * OUT[k].bytes;
    samples(in, in_step, out, out_step, kept, 0);
  }
  for (long k = 0; few && k < NUM_OUT; k++) unpad(to[k], out[k], OUT[k], count * OUT[k].bytes, count);
}

XLA_FFI_Error *handler(XLA_FFI_CallFrame *frame) {
  __typeof__(frame->extension_start) extension = frame->extension_start;  // its type has changed names
  if (extension && extension->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Api_Version *version = &((XLA_FFI_Metadata_Extension *)extension)->metadata->api_version;
    version->major_version = XLA_FFI_API_MAJOR;
    version->minor_version = XLA_FFI_API_MINOR;
    return NULL;
  }
  const char *in[NUM_IN];
  char *out[NUM_OUT];
  int shared[NUM_IN];
  for (long k = 0; k < NUM_IN; k++) {
    XLA_FFI_Buffer *buffer = frame->args.args[k];
    in[k] = buffer->data;
    shared[k] = buffer->rank == IN[k].rank;
  }
  for (long k = 0; k < NUM_OUT; k++) out[k] = ((XLA_FFI_Buffer *)frame->rets.rets[k])->data;
  XLA_FFI_Buffer *result = frame->rets.rets[0];
  long count = 1;
  for (long axis = 0; axis < result->rank - OUT[0].rank; axis++) count *= result->dims[axis];
  batch(count, in, shared, out);
  return NULL;
}
