// The network's first layer on a GPU's tensor cores: convolution, max-pool and ReLU in one, and its gradient.
//
// Images come in as bytes and only pooled values leave: 1 of 9 bytes that PyTorch's operations move. A block
// takes images one after the other. tensor_core_conv.py defines STACK and VIEW. Intensities and their
// gradients are multiplied in bfloat16, where an intensity is exact, and added up in float32.
//
// Words are two bfloat16 numbers each. In shared memory a row of an image is WORDS of them. A window's 5 taps of
// a row are 3 words, the last with a 0 for weight; so that all of K, the taps of all rows and images, is read
// by words, as the tensor cores take them: a lane is (g, q) = (lane / 4, lane % 4).

enum {
  CHANNELS = 32,
  THREADS = 256,
  NUM_WARPS = THREADS / 32,
  POOLED = ((VIEW - 5) / 2 + 1) / 2,
  AREA = POOLED * POOLED,
  WORDS = (VIEW + 2) / 2,  // a tap beyond the last pixel is read, with the weight 0
  PLANE = VIEW * WORDS,
  TAPS = STACK * 15,             // words
  K = (TAPS + 16) / 16 * 16,     // words, with room for the bias
  STEPS = K / 8,                 // of 16 numbers
  TILES = K / 16,                // of 8 numbers that a warp has of four
  SPAN = (AREA + 15) / 16 * 16 + 8,  // numbers; the 8 spread rows over all banks
};

typedef unsigned short Half;  // the upper half of a float: a bfloat16

extern __shared__ unsigned shared[];

#ifndef ON_A_CPU

static __device__ unsigned bits_of(float x) { return __float_as_uint(x); }

// c += a b for 16 x 16 and 16 x 8 numbers, spread over the lanes.
static __device__ void multiply_add(float (&c)[4], const unsigned (&a)[4], const unsigned (&b)[2]) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
}

#endif

// Rounded to the nearest, to even between two.
static __device__ Half half_of(float x) {
  if (x != x) return 0x7fc0;
  const unsigned bits = bits_of(x);
  return (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}

static __device__ unsigned word_of(Half low, Half high) { return low | (unsigned)high << 16; }

// The place in an image's words of a tap's word; of one that is none, some place.
static __device__ int place_of_tap(int word) {
  if (word >= TAPS) return 0;
  return word / 15 * PLANE + word % 15 / 3 * WORDS + word % 3;
}

// Of the first of the four places that a pooled number is the largest of.
static __device__ int place_of_pooled(int position) {
  const int at = position < AREA ? position : AREA - 1;
  return at / POOLED * 4 * WORDS + at % POOLED * 2;
}

static __device__ unsigned weights_of(const float* weight, int channel, int word) {
  if (word >= TAPS) return 0;
  const float* taps = weight + (channel * STACK * 5 + word / 3) * 5 + word % 3 * 2;
  return word_of(half_of(taps[0]), word % 3 < 2 ? half_of(taps[1]) : 0);
}

// One state's images to shared memory.
static __device__ void load(const unsigned char* images, int stack_stride) {
  for (int at = threadIdx.x; at < STACK * PLANE; at += THREADS) {
    const int row = at / WORDS % VIEW, column = at % WORDS * 2;
    const unsigned char* pixels = images + (long long)(at / PLANE) * stack_stride + row * VIEW + column;
    const Half low = column < VIEW ? half_of(pixels[0]) : 0, high = column + 1 < VIEW ? half_of(pixels[1]) : 0;
    shared[at] = word_of(low, high);
  }
}

// images [num, STACK, VIEW, VIEW] with strides, weight [CHANNELS, STACK, 5, 5], bias [CHANNELS];
// pooled [num, AREA, CHANNELS], and which of the four each is, `largest`, alike.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    forward(const unsigned char* images, const float* weight, const float* bias, Half* pooled,
            unsigned char* largest, int num, int stride, int stack_stride) {
  const int warp = threadIdx.x / 32, g = threadIdx.x % 32 / 4, q = threadIdx.x % 4;
  unsigned weights[STEPS][4][2];
  int taps[STEPS][2];
#pragma unroll
  for (int step = 0; step < STEPS; step++)
#pragma unroll
    for (int half = 0; half < 2; half++) {
      const int word = step * 8 + half * 4 + q;
      taps[step][half] = place_of_tap(word);
#pragma unroll
      for (int n = 0; n < 4; n++) weights[step][n][half] = weights_of(weight, n * 8 + g, word);
    }
  for (int state = blockIdx.x; state < num; state += gridDim.x) {
    __syncthreads();
    load(images + (long long)state * stride, stack_stride);
    __syncthreads();
    for (int first = warp * 8; first < AREA; first += NUM_WARPS * 8) {
      const int position = first + g, place = place_of_pooled(position);
      float sums[2][4][4] = {};  // of the upper two and the lower two places
#pragma unroll
      for (int step = 0; step < STEPS; step++)
#pragma unroll
        for (int low = 0; low < 2; low++) {
          const unsigned* at = shared + place + low * 2 * WORDS;
          const int one = taps[step][0], other = taps[step][1];
          const unsigned pixels[4] = {at[one], at[one + 1], at[other], at[other + 1]};
#pragma unroll
          for (int n = 0; n < 4; n++) multiply_add(sums[low][n], pixels, weights[step][n]);
        }
      if (position >= AREA) continue;
#pragma unroll
      for (int n = 0; n < 4; n++) {
        const int channel = n * 8 + q * 2;
        Half values[2];
        int which[2];
#pragma unroll
        for (int i = 0; i < 2; i++) {
          float most = sums[0][n][i];
          which[i] = 0;
          if (sums[0][n][i + 2] > most) most = sums[0][n][i + 2], which[i] = 1;
          if (sums[1][n][i] > most) most = sums[1][n][i], which[i] = 2;
          if (sums[1][n][i + 2] > most) most = sums[1][n][i + 2], which[i] = 3;
          most += bias[channel + i];
          values[i] = half_of(most < 0 ? 0 : most);
        }
        const long long to = ((long long)state * AREA + position) * CHANNELS + channel;
        *(unsigned*)(pooled + to) = word_of(values[0], values[1]);
        *(Half*)(largest + to) = which[0] | which[1] << 8;
      }
    }
  }
}

// gradient like pooled; sums [blocks, CHANNELS, 2 K], for each block's images: of the taps, then of the bias.
extern "C" __global__ void __launch_bounds__(THREADS, 2)
    backward(const unsigned char* images, const Half* gradient, const Half* pooled, const unsigned char* largest,
             float* sums, int num, int stride, int stack_stride) {
  Half* passed = (Half*)(shared + STACK * PLANE);             // [CHANNELS, SPAN], 0 where ReLU cut off
  unsigned char* which = (unsigned char*)(passed + CHANNELS * SPAN);  // alike
  const Half* pixels = (const Half*)shared;
  const int warp = threadIdx.x / 32, g = threadIdx.x % 32 / 4, q = threadIdx.x % 4;
  const int channel = warp % 2 * 16 + g, tile = warp / 2 * TILES;  // and channel + 8
  int taps[TILES];
#pragma unroll
  for (int n = 0; n < TILES; n++) {
    const int number = (tile + n) * 8 + g;
    taps[n] = number == 2 * TAPS ? -1 : place_of_tap(number / 2) * 2 + number % 2;
  }
  for (int at = threadIdx.x; at < CHANNELS * SPAN; at += THREADS) passed[at] = 0, which[at] = 0;
  float total[TILES][4] = {};
  for (int state = blockIdx.x; state < num; state += gridDim.x) {
    __syncthreads();
    load(images + (long long)state * stride, stack_stride);
    for (int at = threadIdx.x; at < AREA * CHANNELS; at += THREADS) {
      const long long from = (long long)state * AREA * CHANNELS + at;
      const int to = at % CHANNELS * SPAN + at / CHANNELS;
      passed[to] = (short)pooled[from] > 0 ? gradient[from] : 0;
      which[to] = largest[from];
    }
    __syncthreads();
    for (int first = 0; first < AREA; first += 16) {
      unsigned words[4], bytes[4];
#pragma unroll
      for (int i = 0; i < 4; i++) {  // of both channels, at both halves of the 16 positions
        const int at = (channel + i % 2 * 8) * SPAN + first + i / 2 * 8 + q * 2;
        words[i] = *(const unsigned*)(passed + at), bytes[i] = *(const Half*)(which + at);
      }
      int places[4];
#pragma unroll
      for (int i = 0; i < 4; i++) places[i] = place_of_pooled(first + i / 2 * 8 + q * 2 + i % 2) * 2;
#pragma unroll
      for (unsigned place = 0; place < 4; place++) {
        unsigned here[4];
#pragma unroll
        for (int i = 0; i < 4; i++)
          here[i] = words[i] & (((bytes[i] & 255) == place ? 0xffff : 0) | (bytes[i] >> 8 == place ? 0xffff0000 : 0));
        const Half* corner = pixels + place / 2 * 4 * WORDS + place % 2 * 2;
#pragma unroll
        for (int n = 0; n < TILES; n++) {
          unsigned intensities[2] = {0x3f803f80, 0x3f803f80};  // ones, for the bias
          if (taps[n] >= 0)
#pragma unroll
            for (int i = 0; i < 2; i++)
              intensities[i] = word_of(corner[places[i * 2] + taps[n]], corner[places[i * 2 + 1] + taps[n]]);
          multiply_add(total[n], here, intensities);
        }
      }
    }
  }
#pragma unroll
  for (int n = 0; n < TILES; n++)
#pragma unroll
    for (int i = 0; i < 4; i++)
      sums[((long long)blockIdx.x * CHANNELS + channel + i / 2 * 8) * 2 * K + (tile + n) * 8 + q * 2 + i % 2] =
          total[n][i];
}
