
#if LONG
extern "C" __global__ void __launch_bounds__(THREADS)
    kernel(const __grid_constant__ struct batch batch, char *memory) {
  const long first = blockIdx.x * (long)THREADS + threadIdx.x, step = 0;
  char *kept = memory + first / 32 * 256 * KEPT + first % 32 * 8;
  for (long lane = first; lane < batch.count; lane += gridDim.x * (long)THREADS) samples(PASSED);
}
#else
extern "C" __global__ void __launch_bounds__(THREADS) kernel(const __grid_constant__ struct batch batch) {
  const long lane = blockIdx.x * (long)THREADS + threadIdx.x, step = 0;
  __align__(8) char kept[8 * KEPT + 8];
  if (lane < batch.count) samples(PASSED);
}
#endif
