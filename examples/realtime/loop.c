/* Run an exported law at 1 kHz against an exported robot.

   python examples/realtime/export.py          writes law.c and plant.c of a double pendulum
   cc -std=c99 -O3 -march=native loop.c law.c plant.c -lm -o loop
   ./loop 100000                               calls in real time, one each ms
   ./loop 10000 --as-fast-as-possible          the same without waiting

   The arm follows sines. The program prints the latency of the law as a histogram, the calls that
   ended after their deadline, and a checksum of the trajectory. It allocates nothing. */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "law.h"
#include "plant.h"

#if law_NUM_COORDINATES != plant_NUM_COORDINATES || law_NUM_INPUTS != plant_NUM_INPUTS
#error "law.c and plant.c are of different robots"
#endif
enum { N = law_NUM_COORDINATES, M = law_NUM_INPUTS, BINS = 12, PERIOD = 1000000 };

static long long now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1000000000LL * t.tv_sec + t.tv_nsec;
}

static void wait_until(long long time) {
  const struct timespec t = {time / 1000000000LL, time % 1000000000LL};
  clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
}

int main(int argc, char **argv) {
  const long calls = argc > 1 ? atol(argv[1]) : 1000;
  const int waiting = argc < 3 || strcmp(argv[2], "--as-fast-as-possible") != 0;
  static long histogram[BINS]; /* calls below 2^k us */
  double q[N] = {0}, v[N] = {0}, q_ref[N], v_ref[N], a_ref[N], u[M];
  double memory[law_MEMORY_SIZE] = {0};
  long misses = 0, flags = 0;
  unsigned long long checksum = 14695981039346656037ULL; /* FNV-1a */
  const long long start = now();

  puts(law_info());
  for (long k = 0; k < calls; k++) {
    if (waiting) wait_until(start + k * PERIOD);
    for (int i = 0; i < N; i++) {
      const double amplitude = 0.2, rate = 2 + i, phase = rate * 1e-9 * PERIOD * (double)k;
      q_ref[i] = amplitude * sin(phase);
      v_ref[i] = amplitude * rate * cos(phase);
      a_ref[i] = -amplitude * rate * rate * sin(phase);
    }
    const long long before = now();
    flags |= law_control(q, v, q_ref, v_ref, a_ref, memory, u, memory);
    const long long after = now();
    plant_step(q, v, u, 1e-9 * PERIOD, q, v);

    int bin = 0;
    while (bin < BINS - 1 && after - before >= 1000LL << bin) bin++;
    histogram[bin]++;
    misses += waiting ? after > start + (k + 1) * PERIOD : after - before > PERIOD;
    const double state[2] = {q[k % N], v[k % N]};
    const unsigned char *bytes = (const unsigned char *)state;
    for (size_t i = 0; i < sizeof state; i++) checksum = (checksum ^ bytes[i]) * 1099511628211ULL;
  }
  for (int bin = 0; bin < BINS - 1; bin++)
    printf("below %4d us: %ld\n", 1 << bin, histogram[bin]);
  printf("more:          %ld\n", histogram[BINS - 1]);
  double error = 0;
  for (int i = 0; i < N; i++) error = fmax(error, fabs(q_ref[i] - q[i]));
  printf("%ld calls, %ld deadline misses, flags %ld, last error %.3g\n", calls, misses, flags, error);
  printf("checksum %016llx\n", checksum);
  return !(error < 0.1);
}
