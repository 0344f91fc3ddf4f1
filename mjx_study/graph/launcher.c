// Called by XLA with arrays of a whole batch in the GPU's memory; starts the kernel, which is part of this library.

#include <dlfcn.h>
#include <stddef.h>

#include "xla/ffi/api/c_api.h"

__asm__(".section .rodata\n.balign 16\nkernel_image:\n.incbin \"kernel\"\n.previous");
extern const char kernel_image[] __attribute__((visibility("hidden")));

typedef int (*launch_kernel)(void *kernel, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned, unsigned shared,
                             void *stream, void **parameters, void **extra);
typedef int (*load_library)(void **library, const void *image, void *, void *, unsigned, void *, void *, unsigned);
typedef int (*get_kernel)(void **kernel, void *library, const char *name);

static launch_kernel launch;
static void *kernel;
static const int RANKS_IN[] = {RANKS_OF_INPUTS};

// Load the kernel for all devices of this process; 0 if that succeeds, else the driver's error, or -1 without a driver.
int prepare(void) {
  void *library, *driver = dlopen("libcuda.so.1", RTLD_NOW);
  if (!driver) return -1;
  load_library load = (load_library)dlsym(driver, "cuLibraryLoadData");
  get_kernel get = (get_kernel)dlsym(driver, "cuLibraryGetKernel");
  launch = (launch_kernel)dlsym(driver, "cuLaunchKernel");
  if (!load || !get || !launch) return -1;
  int failed = load(&library, kernel_image, NULL, NULL, 0, NULL, NULL, 0);
  return failed ? failed : get(&kernel, library, "kernel");
}

XLA_FFI_Error *handler(XLA_FFI_CallFrame *frame) {
  __typeof__(frame->extension_start) extension = frame->extension_start;  // its type has changed names
  if (extension && extension->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)extension)->metadata;
    about->api_version.major_version = XLA_FFI_API_MAJOR;
    about->api_version.minor_version = XLA_FFI_API_MINOR;
    about->traits = XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE;
    return NULL;
  }
  XLA_FFI_Stream_Get_Args got = {sizeof(got), NULL, frame->ctx, NULL};
  XLA_FFI_Error *error = frame->api->XLA_FFI_Stream_Get(&got);
  if (error) return error;
  struct batch batch = {.count = 1};
  for (long k = 0; k < NUM_IN; k++) {
    XLA_FFI_Buffer *buffer = frame->args.args[k];
    batch.in[k] = buffer->data;
    batch.shared[k] = buffer->rank == RANKS_IN[k];
  }
  for (long k = 0; k < NUM_OUT; k++) batch.out[k] = ((XLA_FFI_Buffer *)frame->rets.rets[k])->data;
  XLA_FFI_Buffer *result = frame->rets.rets[0];
  for (long axis = 0; axis < result->rank - RANK_OF_OUTPUT; axis++) batch.count *= result->dims[axis];
  if (!batch.count) return NULL;
  void *parameters[] = {&batch};
  unsigned blocks = (batch.count + THREADS - 1) / THREADS;
  if (launch(kernel, blocks, 1, 1, THREADS, 1, 1, 0, got.stream, parameters, NULL)) {
    XLA_FFI_Error_Create_Args failed = {sizeof(failed), NULL, "the kernel of a step could not be started",
                                        XLA_FFI_Error_Code_INTERNAL};
    return frame->api->XLA_FFI_Error_Create(&failed);
  }
  return NULL;
}
