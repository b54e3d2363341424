// Circuits on an NVIDIA GPU with their amplitudes in registers: float32, compiled by `registers.py` for N qubits.
//
// An amplitude's index has N = R + L + W + C bits. From bit 0 on:
//   R register bits  which of the 2^R amplitudes of a thread; loops over them are unrolled, so that each is a variable
//   L lane bits      which thread of a warp, or of a part of it: 6 qubits are 3 + 3, so a warp has four states of 8 threads
//   W warp bits      which warp of a block: 10 qubits are 4 + 5 + 1
//   C cluster bits   which block of a cluster of two: 14 qubits are 4 + 5 + 4 + 1
// Qubits change their bits. The target of a gate must be a register bit: where it is none, a step before it swaps the
// two, by shuffles with a lane bit, through shared memory with a warp bit, through that of the other block with a cluster
// bit. The control may be any bit. Steps are unitary, and the backward pass undoes them on two states, see `sweeps.py`.
// Every sum has a fixed order, of its own state or seed: the same numbers at every run, and in any company.

#define DEVICE __device__ __forceinline__
#define UNROLL _Pragma("unroll")
constexpr int R = REGISTER_BITS, L = LANE_BITS, W = WARP_BITS, C = CLUSTER_BITS, N = R + L + W + C;
constexpr int A = 1 << R, WARPS = 1 << W, SHARE = 1 << (L + W);     // of a state: in a thread; in a block, and its threads
constexpr int THREADS = W ? SHARE : 128, STATES = THREADS / SHARE;  // of a block
constexpr float ROOT = 0.70710678118654752f;
static_assert((R == 3 || R == 4) && L >= 2 && (L == 5 || !W) && (!C || (C == 1 && W)), "no such bits");

#ifndef EMULATED  // as a test does on a processor
#define SHARED_MEMORY extern __shared__ float4 memory[];
#if CLUSTER_BITS
DEVICE int block_of_cluster() { return __clusterRelativeBlockRank(); }
DEVICE void wait_for_cluster() { __cluster_barrier_arrive(), __cluster_barrier_wait(); }
template <class T> DEVICE const T* other_block(const T* mine) {
  return (const T*)__cluster_map_shared_rank(mine, block_of_cluster() ^ 1);
}
#else
DEVICE int block_of_cluster() { return 0; }
DEVICE void wait_for_cluster() {}
template <class T> DEVICE const T* other_block(const T* mine) { return mine; }
#endif
#endif

enum { GATE, SWAP, FIXED };              // steps
enum { BEFORE = 1, AFTER = 2 };          // Hadamards on its target that a block's matrix contains
enum { AXIS_X, AXIS_Y, AXIS_Z, PHASE };  // rotations

struct Component { int first, last, opening; };  // steps; the bits that are not 0 alone at first, all with equal amplitudes
struct Step { int kind, bit, other, block, idle; };  // other: a control or -1; a thread bit; a place in `moves`
struct Block { int first, last, around; };           // rotations
struct Rotation { int axis, angle; };
struct Angle { int input, scale, weight; };
struct Observable { int component, mask; };
struct Use { int angle, scales; };  // of a parameter by an angle, or of an input
struct Sizes { int components, blocks, angles, observables, inputs, parameters; };

struct Program {  // see `registers.tables`
  const Sizes* count;
  const Component* components;
  const Step* steps;
  const Block* blocks;
  const Rotation* rotations;
  const float* factors;
  const Angle* angles;
  const float* constants;
  const Observable* observables;
  const int* moves;  // whence each amplitude comes, + `NEGATIVE` if it changes its sign; behind that the way back
  const Use* uses;   // by parameter, then by input
  const int* first_use;
};
constexpr int NEGATIVE = 1 << 16;

struct Lane {         // the sample of a seed whose state a thread works on
  long long number;   // through all seeds
  bool real;          // false behind the last: computed, not written
  int thread, share;  // the thread's number in the state, and in the block's share of it
  float4* matrices;   // shared memory of the state: two rows for each block, and for a Hadamard
  float* sums;        // behind them, `WARPS` for each sum
  float2* buffer;     // shared memory of the block through which amplitudes move
  const float *inputs, *flat;
};

DEVICE void wait(bool cluster) {
  if (C && cluster) wait_for_cluster();
  else __syncthreads();
}

template <int V> struct Constant { static constexpr int value = V; };

template <class F> DEVICE void at_register(int bit, F f) {  // unrolled loops need the bit as a constant
  switch (bit) {
    case 0: f(Constant<0>()); break;
    case 1: f(Constant<1>()); break;
    case 2: f(Constant<2>()); break;
    default: if constexpr (R > 3) f(Constant<3>());
  }
}

template <int B> DEVICE constexpr int lower(int n) { return n >> B << (B + 1) | (n & ((1 << B) - 1)); }  // n-th without bit B

DEVICE float angle(const Program& p, const Lane& me, int index) {
  Angle a = p.angles[index];
  float value = p.constants[index];
  if (a.input >= 0) value += a.scale >= 0 ? me.flat[a.scale] * me.inputs[a.input] : me.inputs[a.input];
  return a.weight >= 0 ? value + me.flat[a.weight] : value;
}

// (u.x + i u.y) top + (u.z + i u.w) low, for two complex numbers each
DEVICE float4 combined(float4 u, float4 top, float4 low) {
  return {u.x * top.x - u.y * top.y + u.z * low.x - u.w * low.y, u.x * top.y + u.y * top.x + u.z * low.y + u.w * low.x,
          u.x * top.z - u.y * top.w + u.z * low.z - u.w * low.w, u.x * top.w + u.y * top.z + u.z * low.w + u.w * low.z};
}

// Find a thread's place, and write the rows of the matrix of every block, and behind them of a Hadamard.
DEVICE Lane begin(const Program& p, const float* inputs, const float* flat, long long batch, long long lanes, int own) {
  SHARED_MEMORY
  Lane me;
  me.number = W ? blockIdx.x >> C : blockIdx.x * STATES + (threadIdx.x >> L);
  me.real = me.number < lanes, me.number = me.real ? me.number : lanes - 1;
  me.share = threadIdx.x & (SHARE - 1), me.thread = me.share | block_of_cluster() << (L + W);
  me.matrices = memory + (threadIdx.x >> (L + W)) * own, me.sums = (float*)(me.matrices + 2 * p.count->blocks + 2);
  me.buffer = (float2*)(memory + STATES * own);
  me.inputs = inputs + me.number * p.count->inputs, me.flat = flat + me.number / batch * p.count->parameters;
  const float4 plus = {ROOT, 0, ROOT, 0}, minus = {ROOT, 0, -ROOT, 0};
  for (int g = me.share; g <= p.count->blocks; g += SHARE) {
    Block block = {0, 0, BEFORE};
    if (g < p.count->blocks) block = p.blocks[g];
    float4 top = {1, 0, 0, 0}, low = {0, 0, 1, 0};
    if (block.around & BEFORE) top = plus, low = minus;
    for (int r = block.first; r < block.last; r++) {
      int axis = p.rotations[r].axis;
      float s, c;
      sincosf(angle(p, me, p.rotations[r].angle) * p.factors[r] * (axis == PHASE ? 1.0f : 0.5f), &s, &c);
      float4 u = {c, 0, 0, -s}, v = {0, -s, c, 0}, t = top;
      if (axis == AXIS_Y) u = {c, 0, -s, 0}, v = {s, 0, c, 0};
      if (axis == AXIS_Z) u = {c, -s, 0, 0}, v = {0, 0, c, s};
      if (axis == PHASE) u = {c, s, 0, 0}, v = {0, 0, c, s};
      top = combined(u, t, low), low = combined(v, t, low);
    }
    me.matrices[2 * g] = block.around & AFTER ? combined(plus, top, low) : top;
    me.matrices[2 * g + 1] = block.around & AFTER ? combined(minus, top, low) : low;
  }
  wait(false);
  return me;
}

struct State { float re[A], im[A]; };

DEVICE void multiply(State& s, int i, int j, float4 top, float4 low) {
  float xr = s.re[i], xi = s.im[i], yr = s.re[j], yi = s.im[j];
  s.re[i] = top.x * xr - top.y * xi + top.z * yr - top.w * yi, s.im[i] = top.x * xi + top.y * xr + top.z * yi + top.w * yr;
  s.re[j] = low.x * xr - low.y * xi + low.z * yr - low.w * yi, s.im[j] = low.x * xi + low.y * xr + low.z * yi + low.w * yr;
}

DEVICE void hadamard(State& s, int i, int j) {
  float xr = s.re[i], xi = s.im[i], yr = s.re[j], yi = s.im[j];
  s.re[i] = ROOT * (xr + yr), s.im[i] = ROOT * (xi + yi), s.re[j] = ROOT * (xr - yr), s.im[j] = ROOT * (xi - yi);
}

// The amplitudes of a thread on which a gate acts, as bits.
DEVICE int active(int control, int thread) {
  if (control >= R) return thread >> (control - R) & 1 ? 0xFFFF : 0;
  return control < 0 ? 0xFFFF : int(0xFF00F0F0CCCCAAAAull >> 16 * control & 0xFFFF);
}

// Where its control is 0, a gate with a Hadamard around it is that alone (`idle`).
template <int B> DEVICE void gate(State& s, float4 top, float4 low, int on, bool idle) {
  UNROLL for (int n = 0; n < A / 2; n++) {
    int i = lower<B>(n), j = i | 1 << B;
    if (on >> i & 1) multiply(s, i, j, top, low);
    else if (idle) hadamard(s, i, j);
  }
}

// Undo a gate on psi and lambda; returns T_X, T_Y, and the two sums whose difference is T_Z, whose sum is T_1.
template <int B> DEVICE float4 ungate(State& p, State& l, float4 top, float4 low, int on, bool idle) {
  float4 t = {0, 0, 0, 0}, first = {top.x, -top.y, low.x, -low.y}, second = {top.z, -top.w, low.z, -low.w};
  UNROLL for (int n = 0; n < A / 2; n++) {
    int i = lower<B>(n), j = i | 1 << B;
    if (on >> i & 1) {
      t.x += l.re[i] * p.im[j] - l.im[i] * p.re[j] + l.re[j] * p.im[i] - l.im[j] * p.re[i];
      t.y += l.re[j] * p.re[i] + l.im[j] * p.im[i] - l.re[i] * p.re[j] - l.im[i] * p.im[j];
      t.z += l.re[i] * p.im[i] - l.im[i] * p.re[i];
      t.w += l.re[j] * p.im[j] - l.im[j] * p.re[j];
      multiply(p, i, j, first, second), multiply(l, i, j, first, second);
    } else if (idle) hadamard(p, i, j), hadamard(l, i, j);
  }
  return t;
}

// Swap register bit B with a thread bit: a thread keeps the amplitudes whose B is as its own bit, and gives the others.
template <int B, bool LANES, int K> DEVICE void swap(State (&s)[K], int bit, const Lane& me) {
  bool one = me.thread >> bit & 1, away = bit >= L + W;
  const float2* from = away ? other_block(me.buffer) + threadIdx.x : me.buffer + (threadIdx.x ^ 1 << bit);
  UNROLL for (int put = 0; put < 2; put++) {
    UNROLL for (int k = 0; k < K; k++)
      UNROLL for (int n = 0; n < A / 2; n++) {
        int i = lower<B>(n), j = i | 1 << B, slot = (k * A / 2 + n) * THREADS;
        float2 v = {one ? s[k].re[i] : s[k].re[j], one ? s[k].im[i] : s[k].im[j]};
        if (!put && !LANES) me.buffer[slot + threadIdx.x] = v;
        if (!put) continue;
        if (LANES) v = {__shfl_xor_sync(~0u, v.x, 1 << bit), __shfl_xor_sync(~0u, v.y, 1 << bit)};
        else v = from[slot];
        s[k].re[i] = one ? v.x : s[k].re[i], s[k].im[i] = one ? v.y : s[k].im[i];
        s[k].re[j] = one ? s[k].re[j] : v.x, s[k].im[j] = one ? s[k].im[j] : v.y;
      }
    if (!LANES) wait(away);
  }
}

// Move amplitudes through shared memory, and change signs.
DEVICE void shuffle(State& s, const int* moves, const Lane& me) {
  UNROLL for (int i = 0; i < A; i++) me.buffer[THREADS * i + threadIdx.x] = {s.re[i], s.im[i]};
  wait(true);
  UNROLL for (int i = 0; i < A; i++) {
    int index = moves[me.thread << R | i] & (NEGATIVE - 1);
    const float2* from = (index ^ me.thread << R) >> (R + L + W) ? other_block(me.buffer) : me.buffer;
    float2 v = from[THREADS * (index & (A - 1)) + threadIdx.x - me.share + (index >> R & (SHARE - 1))];
    bool turn = moves[me.thread << R | i] & NEGATIVE;
    s.re[i] = turn ? -v.x : v.x, s.im[i] = turn ? -v.y : v.y;
  }
  wait(true);
}

// Take a step that is no gate, or undo it.
template <int K> DEVICE void move(State (&s)[K], const Program& p, const Step& step, bool undo, const Lane& me) {
  if (step.kind == SWAP)
    at_register(step.bit, [&](auto b) {
      if (step.other < L) swap<b.value, true>(s, step.other, me);
      else swap<b.value, false>(s, step.other, me);
    });
  else UNROLL for (int k = 0; k < K; k++) shuffle(s[k], p.moves + step.other + (undo ? 1 << N : 0), me);
}

// v[m] = the sum of all v[i], negative where i and m have an odd number of bits in common
DEVICE void walsh(float (&v)[A]) {
  UNROLL for (int b = 1; b < A; b *= 2)
    UNROLL for (int i = 0; i < A; i++)
      if (!(i & b)) {
        float x = v[i], y = v[i | b];
        v[i] = x + y, v[i | b] = x - y;
      }
}

// A sum over the warps of a state, of both blocks of a cluster: the caller waits before and behind it.
DEVICE float over_warps(const float* sums, int stride) {
  float total = 0;
  for (int w = 0; w < WARPS; w++) total += sums[stride * w];
  for (int w = 0; C && w < WARPS; w++) total += other_block(sums)[stride * w];
  return total;
}

// Of four numbers of every thread the sums over the lanes of a state: lanes 0 to 3 get one each.
DEVICE float over_lanes(float4 t, int thread) {
  bool odd = thread & 1, high = thread & 2;
  float a = (odd ? t.y : t.x) + __shfl_xor_sync(~0u, odd ? t.x : t.y, 1);
  float b = (odd ? t.w : t.z) + __shfl_xor_sync(~0u, odd ? t.z : t.w, 1);
  float v = (high ? b : a) + __shfl_xor_sync(~0u, high ? a : b, 2);
  UNROLL for (int bit = 4; bit < 1 << L; bit *= 2) v += __shfl_xor_sync(~0u, v, bit);
  return v;
}

// `finals` receive the final states for `backward`, where they are not null.
extern "C" __global__ void __launch_bounds__(THREADS)
forward(const Program* program, const float* inputs, const float* flat, long long batch, long long lanes, long long own,
        float2* finals, float* out) {
  Program p = *program;
  Lane me = begin(p, inputs, flat, batch, lanes, own);
  for (int c = 0; c < p.count->components; c++) {
    Component component = p.components[c];
    float amplitude = exp2f(-0.5f * __popc(component.opening)), chance[A];
    State s[1];
    UNROLL for (int i = 0; i < A; i++)
      s[0].re[i] = (me.thread << R | i) & ~component.opening ? 0.0f : amplitude, s[0].im[i] = 0;
    _Pragma("unroll 1") for (int m = component.first; m < component.last; m++) {
      Step step = p.steps[m];
      if (step.kind == GATE) {
        float4 top = me.matrices[2 * step.block], low = me.matrices[2 * step.block + 1];
        int on = active(step.other, me.thread);
        at_register(step.bit, [&](auto b) { gate<b.value>(s[0], top, low, on, step.idle); });
      } else move(s, p, step, false, me);
    }
    float2* kept = finals + (me.number * p.count->components + c << N) + me.thread;
    UNROLL for (int i = 0; i < A; i++) {
      if (finals && me.real) kept[i << (N - R)] = {s[0].re[i], s[0].im[i]};
      chance[i] = s[0].re[i] * s[0].re[i] + s[0].im[i] * s[0].im[i];
    }
    walsh(chance);
    for (int o = 0; o < p.count->observables; o++) {
      Observable z = p.observables[o];
      if (z.component != c) continue;
      float v = 0;
      UNROLL for (int i = 0; i < A; i++) v = i == (z.mask & (A - 1)) ? chance[i] : v;
      v = __popc(me.thread & z.mask >> R) & 1 ? -v : v;
      UNROLL for (int bit = 1; bit < 1 << L; bit *= 2) v += __shfl_xor_sync(~0u, v, bit);
      if (!(me.share & ((1 << L) - 1))) me.sums[WARPS * o + (me.share >> L)] = v;
    }
  }
  wait(true);
  if (me.real && me.thread == me.share)  // of a cluster, the first block
    for (int o = me.share; o < p.count->observables; o += SHARE)
      out[me.number * p.count->observables + o] = over_warps(me.sums + WARPS * o, 1);
  wait(true);
}

// Turn the overlaps of every block into the slopes of its angles, see `kernels.chain`.
DEVICE void chain(const Program& p, const Lane& me, float* slopes) {
  for (int g = me.share; g < p.count->blocks; g += SHARE) {
    Block block = p.blocks[g];
    float t[4];
    for (int k = 0; k < 4; k++) t[k] = over_warps(me.sums + 4 * WARPS * g + k, 4);
    float x = t[0], y = t[1], z = t[2] - t[3];
    if (block.around & AFTER) x = z, y = -y, z = t[0];  // a Hadamard swaps X and Z, and turns Y around
    for (int r = block.first; r < block.last; r++) slopes[p.rotations[r].angle] = 0;
    for (int r = block.last - 1; r >= block.first; r--) {
      int axis = p.rotations[r].axis, index = p.rotations[r].angle;
      float s, c, a = x, b = y, slope = axis == AXIS_X ? x : axis == AXIS_Y ? y : axis == AXIS_Z ? z : -2 * (t[2] + t[3]);
      sincosf(angle(p, me, index) * p.factors[r], &s, &c);
      if (axis == AXIS_X) y = c * b + s * z, z = c * z - s * b;
      if (axis == AXIS_Y) x = c * a - s * z, z = c * z + s * a;
      if (axis == AXIS_Z) x = c * a + s * b, y = c * b - s * a;
      slopes[index] += p.factors[r] * slope;
    }
  }
}

extern "C" __global__ void __launch_bounds__(THREADS)
backward(const Program* program, const float* inputs, const float* flat, long long batch, long long lanes, long long own,
         const float2* finals, const float* cotangent, float* slopes) {
  Program p = *program;
  Lane me = begin(p, inputs, flat, batch, lanes, own);
  for (int c = 0; c < p.count->components; c++) {
    float factor[A];  // lambda = (sum_o g_o Z_o) psi
    State s[2];       // psi, lambda
    UNROLL for (int i = 0; i < A; i++) factor[i] = 0;
    for (int o = 0; o < p.count->observables; o++) {
      Observable z = p.observables[o];
      float g = z.component == c ? cotangent[me.number * p.count->observables + o] : 0;
      g = __popc(me.thread & z.mask >> R) & 1 ? -g : g;
      UNROLL for (int i = 0; i < A; i++) factor[i] += i == (z.mask & (A - 1)) ? g : 0;
    }
    walsh(factor);
    UNROLL for (int i = 0; i < A; i++) {
      float2 v = finals[(me.number * p.count->components + c << N) + (i << (N - R)) + me.thread];
      s[0].re[i] = v.x, s[0].im[i] = v.y, s[1].re[i] = factor[i] * v.x, s[1].im[i] = factor[i] * v.y;
    }
    _Pragma("unroll 1") for (int m = p.components[c].last - 1; m >= p.components[c].first; m--) {
      Step step = p.steps[m];
      if (step.kind == GATE) {
        float4 top = me.matrices[2 * step.block], low = me.matrices[2 * step.block + 1], t;
        int on = active(step.other, me.thread), lane = me.share & ((1 << L) - 1);
        at_register(step.bit, [&](auto b) { t = ungate<b.value>(s[0], s[1], top, low, on, step.idle); });
        if (step.block == p.count->blocks) continue;  // a Hadamard has no angle
        float sum = over_lanes(t, me.thread);
        if (lane < 4) me.sums[4 * (WARPS * step.block + (me.share >> L)) + lane] = sum;
      } else move(s, p, step, true, me);
    }
  }
  wait(true);
  // Its tables are read again, so that the loop before need not hold their places in registers.
  if (me.real && me.thread == me.share) chain(*program, me, slopes + me.number * p.count->angles);
  wait(true);
}

// Add slopes up: a thread for each parameter of a seed, over its samples, then for each input of a sample.
extern "C" __global__ void collect(const Program* program, const float* inputs, const float* flat, long long batch,
                                   long long lanes, const float* slopes, float* grad_inputs, float* grad_flat) {
  Program p = *program;
  Sizes count = *p.count;
  long long me = (long long)blockIdx.x * blockDim.x + threadIdx.x, of_flat = lanes / batch * count.parameters;
  bool summed = me < of_flat;
  if (me >= of_flat + lanes * count.inputs) return;
  long long row = summed ? me / count.parameters : (me - of_flat) / count.inputs;
  int column = summed ? me % count.parameters : count.parameters + (me - of_flat) % count.inputs;
  float total = 0;
  for (int u = p.first_use[column]; u < p.first_use[column + 1]; u++) {
    Use use = p.uses[u];
    Angle a = p.angles[use.angle];
    bool times = summed ? use.scales : a.scale >= 0;  // an angle is scale * input + weight
    for (long long lane = summed ? row * batch : row; lane < (summed ? (row + 1) * batch : row + 1); lane++) {
      const float* other = summed ? inputs + lane * count.inputs + a.input : flat + lane / batch * count.parameters + a.scale;
      total += slopes[lane * count.angles + use.angle] * (times ? *other : 1.0f);
    }
  }
  (summed ? grad_flat + me : grad_inputs + me - of_flat)[0] = total;
}
