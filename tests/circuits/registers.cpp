// The kernels of `registers.cu` on a processor: each GPU thread is a fiber, and all take turns on one thread.
#include <cmath>
#include <cstdlib>
#include <ucontext.h>
#include <vector>

#define EMULATED
#define __device__
#define __global__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define SHARED_MEMORY float4* memory = (float4*)rooms[block_of_cluster()].data();
struct float2 { float x, y; };
struct alignas(16) float4 { float x, y, z, w; };
struct Number { int x; };
static inline int __popc(unsigned x) { return __builtin_popcount(x); }

constexpr int MOST = 1 << (LANE_BITS + WARP_BITS + CLUSTER_BITS) > 128 ? 1 << (LANE_BITS + WARP_BITS + CLUSTER_BITS) : 128;
constexpr int BLOCKS = 1 << CLUSTER_BITS, STACK = 1 << 16;
static Number threadIdx, blockIdx, blockDim;
static std::vector<float4> rooms[BLOCKS];
static ucontext_t fibers[MOST], scheduler;
static int running, cluster, kinds[MOST], turns[MOST];
static float slots[2][MOST];
enum { DONE, SHUFFLE, BLOCK, CLUSTER };

static void pause(int kind) {
  kinds[running] = kind;
  swapcontext(&fibers[running], &scheduler);
}
static inline int block_of_cluster() { return running / blockDim.x; }
static inline void __syncthreads() { pause(BLOCK); }
static inline void wait_for_cluster() { pause(CLUSTER); }
template <class T> static const T* other_block(const T* mine) {
  int rank = block_of_cluster();
  const char *from = (const char*)rooms[rank].data(), *to = (const char*)rooms[rank ^ (BLOCKS - 1)].data();
  return (const T*)(to + ((const char*)mine - from));
}
static inline float __shfl_xor_sync(unsigned, float value, int mask) {
  int me = running, turn = turns[me]++ & 1;
  if (mask >= 32) abort();
  slots[turn][me] = value;
  pause(SHUFFLE);
  return slots[turn][me ^ mask];
}

#include KERNELS

static const char* which;
static const long long* given;
static void body() {
  const long long* a = given;
  auto f = [&](int k) { return (float*)a[k]; };
  if (*which == 'f') forward((const Program*)a[0], f(1), f(2), a[3], a[4], a[5], (float2*)a[6], f(7));
  else if (*which == 'b') backward((const Program*)a[0], f(1), f(2), a[3], a[4], a[5], (float2*)a[6], f(7), f(8));
  else collect((const Program*)a[0], f(1), f(2), a[3], a[4], f(5), f(6), f(7));
  kinds[running] = DONE;
}

// Resume the threads from `first` on, in groups of `sizes[kind]` that wait for each other there; false where they do not
// all wait at the same kind of place. A group goes on for as long as it can, so that data for which it should have
// waited for another are not there yet, or not any more.
static bool resume(int first, int kind, const int* sizes) {
  if (kind == DONE) {
    running = first, threadIdx.x = first % blockDim.x, blockIdx.x = cluster * (sizes[CLUSTER] / blockDim.x) + first / blockDim.x;
    swapcontext(&scheduler, &fibers[first]);
    return true;
  }
  do {
    for (int t = first; t < first + sizes[kind]; t += sizes[kind - 1])
      if (!resume(t, kind - 1, sizes) || kinds[t] != kinds[first]) return false;
  } while (kinds[first] == kind);
  return true;
}

extern "C" int launch(const char* kernel, int clusters, int blocks, int threads, int bytes, const long long* arguments) {
  static std::vector<char> stacks(size_t(MOST) * STACK);
  which = kernel, given = arguments, blockDim.x = threads;
  const int sizes[] = {1, 32, threads, blocks * threads};  // that wait together: itself, and for SHUFFLE, BLOCK, CLUSTER
  for (cluster = 0; cluster < clusters; cluster++) {
    for (int b = 0; b < blocks; b++) rooms[b].assign(bytes / 16, float4{NAN, NAN, NAN, NAN});
    for (int t = 0; t < blocks * threads; t++) {
      getcontext(&fibers[t]);
      fibers[t].uc_stack.ss_sp = &stacks[size_t(t) * STACK], fibers[t].uc_stack.ss_size = STACK, fibers[t].uc_link = &scheduler;
      makecontext(&fibers[t], body, 0);
    }
    if (!resume(0, CLUSTER, sizes) || kinds[0] != DONE) return 1;
  }
  return 0;
}
