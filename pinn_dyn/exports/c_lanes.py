"""C code of a loop over steps, for one trajectory or for several side by side in vectors."""

from __future__ import annotations

ONE = """\
#include <string.h>
#define LANES 1
#define lanes(x) (x)
typedef double real;
"""
"""First lines of the code for one trajectory at a time, before the functions of the code."""

SEVERAL = """\
#include <math.h>
#include <string.h>

#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
typedef double real __attribute__((vector_size(8 * LANES)));
typedef long long flag __attribute__((vector_size(8 * LANES)));

#define LANEWISE(f) static inline real lanes_##f(real x) { \\
  double y[LANES]; memcpy(y, &x, sizeof x); \\
  for (int l = 0; l < LANES; l++) y[l] = f(y[l]); \\
  memcpy(&x, y, sizeof x); return x; }
#define PAIRWISE(f) static inline real lanes_##f(real x, real z) { \\
  double y[LANES], w[LANES]; memcpy(y, &x, sizeof x); memcpy(w, &z, sizeof z); \\
  for (int l = 0; l < LANES; l++) y[l] = f(y[l], w[l]); \\
  memcpy(&x, y, sizeof x); return x; }
@functions@

#define lanes(x) ((x) - (real){0})
static inline real chosen(flag mask, real a, real b)
{ return (real)((mask & (flag)a) | (~mask & (flag)b)); }
#define choose(mask, a, b) chosen((mask) != (flag){0}, lanes(a), lanes(b))
static inline real square(real x) { return x * x; }
static inline real larger(real a, real b) { return choose((a > b) | (a != a), a, b); }
static inline real smaller(real a, real b) { return choose((a < b) | (a != a), a, b); }
static inline real sign(real x) { return choose(x > 0, 1.0, 0.0) - choose(x < 0, 1.0, 0.0); }
static inline real sigmoid(real x) { return 1 / (1 + exp(-x)); }
#define square(x) square(lanes(x))
#define larger(a, b) larger(lanes(a), lanes(b))
#define smaller(a, b) smaller(lanes(a), lanes(b))
#define sign(x) sign(lanes(x))
#define sigmoid(x) sigmoid(lanes(x))
"""
_OF_ONE = "sqrt exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh erf floor fabs"
_OF_TWO = "atan2 pow fmod"
_functions = [f"LANEWISE({f})\n#define {f}(x) lanes_{f}(lanes(x))" for f in _OF_ONE.split()]
_functions += [
    f"PAIRWISE({f})\n#define {f}(x, y) lanes_{f}(lanes(x), lanes(y))" for f in _OF_TWO.split()
]
SEVERAL = SEVERAL.replace("@functions@", "\n".join(_functions))
"""The same for as many trajectories as a vector of the processor has numbers."""

LOOP = """
#define LANE(x, l) (((double *)&(x))[l])

static void pack(real *to, const double *from, long stride, long size, long count)
{{
  for (long i = 0; i < size; i++)
    for (int l = 0; l < LANES; l++)
      LANE(to[i], l) = from[(l < count ? l : 0) * stride + i];
}}

static void unpack(double *to, const real *from, long stride, long size, long count)
{{
  for (int l = 0; l < LANES && l < count; l++)
    for (long i = 0; i < size; i++)
      to[l * stride + i] = LANE(from[i], l);
}}

int number_of_lanes(void) {{ return LANES; }}

/* The increments of path (count, steps + 1, {size}) after the first. */
void roll_out(double *values, long count, long steps, const double *start, const double *inputs,
              const double *lengths, double *path)
{{
  const long width = (steps + 1) * {size}, length = steps * {stages};
  for (long b = 0; b < count; b += LANES) {{
    real x[{size}], u[{stages} + 1], increment[{size}], next[{size}];
    double *now = path + b * width;
    pack(x, start + b * {size}, {size}, {size}, count - b);
    pack(increment, now, width, {size}, count - b);
    for (long k = 0; k < steps; k++) {{
      pack(u, inputs + b * length + k * {stages}, length, {stages}, count - b);
      integration_step(values, increment, x, u, lengths[k], next);
      memcpy(increment, next, sizeof next);
      now += {size};
      unpack(now, increment, width, {size}, count - b);
    }}
  }}
}}
"""
