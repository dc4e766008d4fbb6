// The analytic renderer of common/arena/images/views.py for a GPU: a block renders an image, a thread pixels of it.
//
// It repeats the host's scan lines and order of painting, places in float64 and shares of pixels in float32:
// a pixel is a grey level off at most. Whoever compiles it defines the configuration (services/learner/
// rendering.py); px are the arena's, all else is in pixels of the image. Records of any bytes give some image.
// A host's compiler takes it too, for the tests.

#ifdef __CUDACC__
#define FUNCTION static __device__
#define CONSTANT static __device__ const
#else
#include <cmath>
#define FUNCTION static
#define CONSTANT static const
#endif

CONSTANT double node[4] = NODES;
CONSTANT float weight[4] = WEIGHTS;
CONSTANT double inner_wall[NUM_INNER_WALLS + 1][5] = INNER_WALLS;  // ends and half the width, px

enum {
  FIRST_INNER = 4,
  FIRST_OBSTACLE = FIRST_INNER + NUM_INNER_WALLS,
  FIRST_TARGET = FIRST_OBSTACLE + NUM_OBSTACLES,
  FIRST_ROBOT = FIRST_TARGET + NUM_TARGETS,
  FIRST_HEADING = FIRST_ROBOT + NUM_ROBOTS,
  NUM_SHAPES = FIRST_HEADING + NUM_ROBOTS,
  TARGETS = 3 * NUM_ROBOTS,  // in a record
  OBSTACLES = TARGETS + 2 * NUM_TARGETS,
  RECORD = OBSTACLES + 3 * NUM_OBSTACLES,
};

// Where the robot is that the image belongs to, and how the arena is turned about it.
struct Eye {
  double x, y, c, s;
};

// A disc, or the rectangle from start to end along (dx, dy), half to either side. Rows and columns change
// places where it lies flat, so that scan lines cross it the short way.
struct Shape {
  double x, y, dx, dy, start, end, half;
  double low_x, high_x, low_y, high_y;
  int grey;
  bool flat, round;
};

// The middle of a square, once its edges lie between pixels.
FUNCTION double on_grid(double middle, double half) { return rint(middle - half) + half; }

FUNCTION Eye eye_of(const float* scene) {
  if (HEADING_UP) return {scene[0], scene[1], -sinf(scene[2]), -cosf(scene[2])};
  return {on_grid(scene[0], CROP_HALF_PX), on_grid(scene[1], CROP_HALF_PX), 1, 0};
}

FUNCTION double column_of(Eye eye, double x, double y) {
  return (eye.c * (x - eye.x) - eye.s * (y - eye.y)) * SCALE + 0.5 * VIEW;
}

FUNCTION double row_of(Eye eye, double x, double y) {
  return (eye.s * (x - eye.x) + eye.c * (y - eye.y)) * SCALE + 0.5 * VIEW;
}

FUNCTION Shape disc(double x, double y, double radius, int grey) {
  return {x, y, 0, 0, 0, 0, radius, x - radius, x + radius, y - radius, y + radius, grey, false, true};
}

FUNCTION Shape bar(double x, double y, double dx, double dy, double start, double end, double half, int grey) {
  const bool flat = fabs(dx) >= fabs(dy);
  if (flat) {
    const double held_x = x, held_dx = dx;
    x = y, y = held_x, dx = dy, dy = held_dx;
  }
  const double across = half * fabs(dy), along = half * fabs(dx);
  return {x, y, dx, dy, start, end, half,
          x + fmin(start * dx, end * dx) - across, x + fmax(start * dx, end * dx) + across,
          y + fmin(start * dy, end * dy) - along,  y + fmax(start * dy, end * dy) + along,
          grey, flat, false};
}

// Along (dx, dy) of the arena from (x, y) px, `length` px.
FUNCTION Shape wall(Eye eye, double x, double y, double dx, double dy, double length, double half) {
  return bar(column_of(eye, x, y), row_of(eye, x, y), eye.c * dx - eye.s * dy, eye.s * dx + eye.c * dy,
             0, length * SCALE, half * SCALE, WALL_INTENSITY);
}

// The shapes in the order in which they are painted.
FUNCTION Shape shape_of(const float* scene, int which) {
  const Eye eye = eye_of(scene);
  if (which < FIRST_INNER) {  // top and bottom from corner to corner, left and right between them
    const double half = 0.5 * (WALL_INNER_PX - WALL_OUTER_PX);
    const double middle = WALL_OUTER_PX + half, at = which & 1 ? SIZE_PX - middle : middle;
    if (which < 2) return wall(eye, WALL_OUTER_PX, at, 1, 0, SIZE_PX - 2 * WALL_OUTER_PX, half);
    return wall(eye, at, WALL_INNER_PX, 0, 1, SIZE_PX - 2 * WALL_INNER_PX, half);
  }
  if (which < FIRST_OBSTACLE) {
    const double* w = inner_wall[which - FIRST_INNER];
    const double length = sqrt((w[2] - w[0]) * (w[2] - w[0]) + (w[3] - w[1]) * (w[3] - w[1]));
    return wall(eye, w[0], w[1], (w[2] - w[0]) / length, (w[3] - w[1]) / length, length, w[4]);
  }
  if (which < FIRST_TARGET) {
    const float* at = scene + OBSTACLES + 3 * (which - FIRST_OBSTACLE);
    const double radius = (at[2] - DISC_LOSS_PX) * SCALE;
    return disc(column_of(eye, at[0], at[1]), row_of(eye, at[0], at[1]), radius, OBSTACLE_INTENSITY);
  }
  if (which < FIRST_ROBOT) {
    const float* at = scene + TARGETS + 2 * (which - FIRST_TARGET);
    const double x = on_grid(at[0], TARGET_HALF_PX), y = on_grid(at[1], TARGET_HALF_PX);
    const double half = TARGET_HALF_PX * SCALE;
    return bar(column_of(eye, x, y), row_of(eye, x, y), eye.c, eye.s, -half, half, half, TARGET_INTENSITY);
  }
  const float* robot = scene + 3 * ((which - FIRST_ROBOT) % NUM_ROBOTS);
  const double x = column_of(eye, robot[0], robot[1]), y = row_of(eye, robot[0], robot[1]);
  if (which < FIRST_HEADING) return disc(x, y, RADIUS, ROBOT_INTENSITY);
  const double cos = cosf(robot[2]), sin = sinf(robot[2]);
  return bar(x, y, eye.c * cos - eye.s * sin, eye.s * cos + eye.c * sin, -CAP, RADIUS + CAP, HAND_HALF,
             HEADING_INTENSITY);
}

FUNCTION float part(double low, double high, double left) {
  return fmaxf(fminf((float)(high - left), 1.f) - fmaxf((float)(low - left), 0.f), 0.f);
}

// How much of the pixel [left, left + 1] x [top, top + 1] the shape covers.
FUNCTION float share_of(const Shape& shape, double left, double top) {
  const double first = fmax(top, shape.low_y) - shape.y;
  const double tall = fmin(top + 1, shape.high_y) - shape.y - first;
  float share = 0;
  for (int k = 0; k < 4; k++) {
    const double t = first + node[k] * tall;
    double low, high;
    if (shape.round) {
      const double chord = sqrt(fmax(shape.half * shape.half - t * t, 0));
      low = shape.x - chord, high = shape.x + chord;
    } else {
      const double middle = shape.x + t * shape.dx / shape.dy, width = shape.half / fabs(shape.dy);
      const double across = 1 / (fabs(shape.dx) > 1e-9 ? shape.dx : 1e-9);
      const double one = shape.x + (shape.start - t * shape.dy) * across;
      const double other = shape.x + (shape.end - t * shape.dy) * across;
      low = fmax(middle - width, fmin(one, other)), high = fmin(middle + width, fmax(one, other));
    }
    share += weight[k] * (float)tall * part(low, high, left);
  }
  return fminf(share, 1);
}

FUNCTION unsigned char pixel_of(const Shape* shapes, int row, int column) {
  float value = 0;
  for (int k = 0; k < NUM_SHAPES; k++) {
    const Shape& shape = shapes[k];
    const double left = shape.flat ? row : column, top = shape.flat ? column : row;
    const bool meets = left + 1 > shape.low_x && left < shape.high_x && top + 1 > shape.low_y && top < shape.high_y;
    if (meets) value = floorf(value + (shape.grey - value) * share_of(shape, left, top) + 0.5f);
  }
  return (unsigned char)value;
}

// The same of the image as a symmetry maps it: 4 transposes, then 2 flips left and right, 1 top and bottom.
FUNCTION unsigned char turned_pixel_of(const Shape* shapes, int symmetry, int row, int column) {
  if (symmetry & 1) row = VIEW - 1 - row;
  if (symmetry & 2) column = VIEW - 1 - column;
  return symmetry & 4 ? pixel_of(shapes, column, row) : pixel_of(shapes, row, column);
}

#ifdef __CUDACC__

// scenes [B, W, RECORD], symmetries [B], images [B, W, VIEW, VIEW]; a block for each of B x W.
extern "C" __global__ void render(const float* scenes, const unsigned char* symmetries, unsigned char* images,
                                int width) {
  __shared__ Shape shapes[NUM_SHAPES];
  const size_t image = blockIdx.x;
  for (int k = threadIdx.x; k < NUM_SHAPES; k += blockDim.x) shapes[k] = shape_of(scenes + image * RECORD, k);
  __syncthreads();
  const int symmetry = symmetries[image / width];
  for (int at = threadIdx.x; at < VIEW * VIEW; at += blockDim.x)
    images[image * VIEW * VIEW + at] = turned_pixel_of(shapes, symmetry, at / VIEW, at % VIEW);
}

#else

extern "C" void render(const float* scenes, const unsigned char* symmetries, unsigned char* images, int width,
                     int num) {
  for (long image = 0; image < num; image++) {
    Shape shapes[NUM_SHAPES];
    for (int k = 0; k < NUM_SHAPES; k++) shapes[k] = shape_of(scenes + image * RECORD, k);
    for (int at = 0; at < VIEW * VIEW; at++)
      images[image * VIEW * VIEW + at] =
          turned_pixel_of(shapes, symmetries[image / width], at / VIEW, at % VIEW);
  }
}

#endif
