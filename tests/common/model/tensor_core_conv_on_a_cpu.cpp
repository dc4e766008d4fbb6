#include "cuda_on_a_cpu.h"
#include FIRST_LAYER

extern "C" void forward_on_a_cpu(int blocks, const unsigned char* images, const float* weight, const float* bias,
                                 Half* pooled, unsigned char* largest, int num, int stride, int stack_stride) {
  launch(blocks, THREADS, [=] { forward(images, weight, bias, pooled, largest, num, stride, stack_stride); });
}

extern "C" void backward_on_a_cpu(int blocks, const unsigned char* images, const Half* gradient, const Half* pooled,
                                  const unsigned char* largest, float* sums, int num, int stride, int stack_stride) {
  launch(blocks, THREADS,
         [=] { backward(images, gradient, pooled, largest, sums, num, stride, stack_stride); });
}
