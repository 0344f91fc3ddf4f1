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
#if LONG
typedef int (*get_device)(int *device);
typedef int (*get_attribute)(int *value, int attribute, int device);
static get_device current_device;
static get_attribute device_attribute;
enum { NUM_PROCESSORS = 16, BLOCKS_OF_PROCESSOR = 2 };
#endif
static const int RANKS_IN[] = {RANKS_OF_INPUTS};

// Load the kernel for all devices of this process; 0 if that succeeds, else the driver's error, or -1 without a driver.
int prepare(void) {
  void *library, *driver = dlopen("libcuda.so.1", RTLD_NOW);
  if (!driver) return -1;
  load_library load = (load_library)dlsym(driver, "cuLibraryLoadData");
  get_kernel get = (get_kernel)dlsym(driver, "cuLibraryGetKernel");
  launch = (launch_kernel)dlsym(driver, "cuLaunchKernel");
  if (!load || !get || !launch) return -1;
#if LONG
  current_device = (get_device)dlsym(driver, "cuCtxGetDevice");
  device_attribute = (get_attribute)dlsym(driver, "cuDeviceGetAttribute");
  if (!current_device || !device_attribute) return -1;
#endif
  int failed = load(&library, kernel_image, NULL, NULL, 0, NULL, NULL, 0);
  return failed ? failed : get(&kernel, library, "kernel");
}

XLA_FFI_Error *handler(XLA_FFI_CallFrame *frame) {
  __typeof__(frame->extension_start) extension = frame->extension_start;  // its type has changed names
  if (extension && extension->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)extension)->metadata;
    about->api_version.major_version = XLA_FFI_API_MAJOR;
    about->api_version.minor_version = XLA_FFI_API_MINOR;
    if (!LONG) about->traits = XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE;
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
  unsigned blocks = (batch.count + THREADS - 1) / THREADS;
  int failed = 0;
#if LONG  // memory for the samples that are computed at once
  int device, processors = 0;
  failed = current_device(&device) || device_attribute(&processors, NUM_PROCESSORS, device);
  unsigned most = processors * BLOCKS_OF_PROCESSOR;
  if (blocks > most) blocks = most;
  size_t bytes = 8UL * KEPT * THREADS * blocks;
  XLA_FFI_DeviceMemory_Allocate_Args memory = {sizeof(memory), NULL, frame->ctx, bytes, 8, NULL};
  if (bytes && (error = frame->api->XLA_FFI_DeviceMemory_Allocate(&memory))) return error;
  void *parameters[] = {&batch, &memory.data};
#else
  void *parameters[] = {&batch};
#endif
  failed = failed || launch(kernel, blocks, 1, 1, THREADS, 1, 1, 0, got.stream, parameters, NULL);
#if LONG
  XLA_FFI_DeviceMemory_Free_Args done = {sizeof(done), NULL, frame->ctx, bytes, memory.data};
  if (bytes && (error = frame->api->XLA_FFI_DeviceMemory_Free(&done))) return error;
#endif
  if (!failed) return NULL;
  XLA_FFI_Error_Create_Args reported = {sizeof(reported), NULL, "the kernel of a step could not be started",
                                        XLA_FFI_Error_Code_INTERNAL};
  return frame->api->XLA_FFI_Error_Create(&reported);
}
