// Called by XLA with arrays of a whole batch, which is their fastest dimension; arrays without one are the same for all
// samples, and pass through `padded`. So do batches smaller than a vector, whose surplus lanes repeat the last sample; in
// others, the last vector ends with the last sample, and computes some of its samples again. Large batches are computed in
// shares, by the thread that calls and those of XLA's pool that are free: it never waits for one that has not begun.

#include <sched.h>
#include <stdlib.h>

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

#define SHARE 300000  // least work of a share, in operations on vectors: about a tenth of a millisecond

struct batch {
  long count, each;  // samples, in all and in a share
  const char *from[NUM_IN];
  char *to[NUM_OUT];
  int shared[NUM_IN];
  long begun, done, holders;
};

static void samples_from(const struct batch *all, long begin, long end) {
  const long count = all->count;
  const char *const *from = all->from;
  char *const *to = all->to;
  const int *shared = all->shared;
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
  for (long first = begin; first < end; first += LANES) {
    if (!few && first > count - LANES) first = count - LANES;
    for (long k = 0; k < NUM_IN; k++) in[k] = few || shared[k] ? spare[k] : from[k] + first * IN[k].bytes;
    for (long k = 0; k < NUM_OUT; k++) out[k] = few ? spare[NUM_IN + k] : to[k] + first * OUT[k].bytes;
    samples(in, in_step, out, out_step, kept, 0);
  }
  for (long k = 0; few && k < NUM_OUT; k++) unpad(to[k], out[k], OUT[k], count * OUT[k].bytes, count);
}

static void take_shares(struct batch *all) {
  for (long begin; (begin = __atomic_fetch_add(&all->begun, all->each, __ATOMIC_RELAXED)) < all->count;) {
    long end = begin + all->each < all->count ? begin + all->each : all->count;
    samples_from(all, begin, end);
    __atomic_fetch_add(&all->done, end - begin, __ATOMIC_RELEASE);
  }
}

static void let_go(struct batch *all) {
  if (__atomic_sub_fetch(&all->holders, 1, __ATOMIC_ACQ_REL) == 0) free(all);
}

static void help(void *all) {
  take_shares(all);
  let_go(all);
}

static int failed(XLA_FFI_CallFrame *frame, XLA_FFI_Error *error) {
  if (!error) return 0;
  XLA_FFI_Error_Destroy_Args args = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, NULL, error};
  frame->api->XLA_FFI_Error_Destroy(&args);
  return 1;
}

static void compute(struct batch *here, XLA_FFI_CallFrame *frame) {
  const long vectors = (here->count + LANES - 1) / LANES, least = SHARE / (OPERATIONS) + 1;
  const char *most = getenv("MJX_STUDY_THREADS");
  int64_t threads = 1;
  XLA_FFI_ThreadPool_NumThreads_Args asked = {XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, NULL, frame->ctx, &threads};
  if (vectors < 2 * least || failed(frame, frame->api->XLA_FFI_ThreadPool_NumThreads(&asked))) threads = 1;
  if (most && atol(most) < threads) threads = atol(most);
  if (threads < 2) {
    samples_from(here, 0, here->count);
    return;
  }
  struct batch *all = malloc(sizeof(*all));
  *all = *here;
  const long even = (vectors + 4 * threads - 1) / (4 * threads), each = even > least ? even : least;
  all->each = each * LANES;
  const long shares = (vectors + each - 1) / each, helpers = (shares < threads ? shares : threads) - 1;
  all->holders = helpers + 1;
  XLA_FFI_ThreadPool_Schedule_Args args = {XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, NULL, frame->ctx, help, all};
  for (long k = 0; k < helpers; k++)
    if (failed(frame, frame->api->XLA_FFI_ThreadPool_Schedule(&args))) let_go(all);
  take_shares(all);
  while (__atomic_load_n(&all->done, __ATOMIC_ACQUIRE) < all->count) sched_yield();
  let_go(all);
}

XLA_FFI_Error *handler(XLA_FFI_CallFrame *frame) {
  __typeof__(frame->extension_start) extension = frame->extension_start;  // its type has changed names
  if (extension && extension->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Api_Version *version = &((XLA_FFI_Metadata_Extension *)extension)->metadata->api_version;
    version->major_version = XLA_FFI_API_MAJOR;
    version->minor_version = XLA_FFI_API_MINOR;
    return NULL;
  }
  struct batch all = {.count = 1};
  for (long k = 0; k < NUM_IN; k++) {
    XLA_FFI_Buffer *buffer = frame->args.args[k];
    all.from[k] = buffer->data;
    all.shared[k] = buffer->rank == IN[k].rank;
  }
  for (long k = 0; k < NUM_OUT; k++) all.to[k] = ((XLA_FFI_Buffer *)frame->rets.rets[k])->data;
  XLA_FFI_Buffer *result = frame->rets.rets[0];
  for (long axis = 0; axis < result->rank - OUT[0].rank; axis++) all.count *= result->dims[axis];
  compute(&all, frame);
  return NULL;
}
