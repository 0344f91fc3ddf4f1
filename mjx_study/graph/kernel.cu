
extern "C" __global__ void __launch_bounds__(THREADS) kernel(const __grid_constant__ struct batch batch) {
  const long lane = blockIdx.x * (long)THREADS + threadIdx.x;
  __align__(8) char kept[8 * KEPT + 8];
  const long step = 0;
  if (lane < batch.count) samples(PASSED);
}
