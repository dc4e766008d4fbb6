// Enough of CUDA to run a kernel's source on a CPU: a block after the other, a thread of the system for each thread.
#pragma once
#include <barrier>
#include <cstring>
#include <memory>
#include <thread>
#include <vector>

#define ON_A_CPU
#define __global__
#define __device__
#define __shared__
#define __launch_bounds__(threads, blocks)

struct Index {
  int x;
};
static thread_local Index threadIdx, blockIdx, gridDim;
unsigned shared[1 << 16];
static std::unique_ptr<std::barrier<>> block;

struct Warp {
  std::barrier<> barrier{32};
  unsigned a[32][4], b[32][2];
};
static std::vector<std::unique_ptr<Warp>> warps;

static void __syncthreads() { block->arrive_and_wait(); }

static unsigned bits_of(float x) {
  unsigned bits;
  memcpy(&bits, &x, 4);
  return bits;
}

static float number_of(unsigned word, int which) {
  const unsigned bits = which ? word & 0xffff0000 : word << 16;
  float x;
  memcpy(&x, &bits, 4);
  return x;
}

// As the manual of PTX spreads mma.m16n8k16 over the lanes.
static void multiply_add(float (&c)[4], const unsigned (&a)[4], const unsigned (&b)[2]) {
  Warp& warp = *warps[threadIdx.x / 32];
  const int lane = threadIdx.x % 32;
  memcpy(warp.a[lane], a, sizeof a), memcpy(warp.b[lane], b, sizeof b);
  warp.barrier.arrive_and_wait();
  for (int i = 0; i < 4; i++) {
    const int row = lane / 4 + i / 2 * 8, column = lane % 4 * 2 + i % 2;
    for (int k = 0; k < 16; k++) {
      const unsigned* from = warp.a[row % 8 * 4 + k % 8 / 2];
      const float left = number_of(from[row / 8 + k / 8 * 2], k % 2);
      const float right = number_of(warp.b[column * 4 + k % 8 / 2][k / 8], k % 2);
      c[i] += left * right;
    }
  }
  warp.barrier.arrive_and_wait();
}

template <typename Kernel>
static void launch(int blocks, int threads, Kernel kernel) {
  for (int which = 0; which < blocks; which++) {
    memset(shared, 0xff, sizeof shared);  // nobody relies on zeros
    block = std::make_unique<std::barrier<>>(threads);
    warps.clear();
    for (int i = 0; i < threads / 32; i++) warps.push_back(std::make_unique<Warp>());
    std::vector<std::thread> all;
    for (int i = 0; i < threads; i++)
      all.emplace_back([=] {
        threadIdx = {i}, blockIdx = {which}, gridDim = {blocks};
        kernel();
      });
    for (auto& one : all) one.join();
  }
}
