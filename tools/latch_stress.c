/*
 * Readers for tools/bench_tearing.py: read as fast as possible and check every snapshot.
 *
 *     latch_stress words PATH WORDS SECONDS    a latch in a file; every word of a payload must be equal
 *     latch_stress naive PATH WORDS SECONDS    the same without the latch's recheck: must see torn ones
 *     latch_stress output NAME SECONDS TABLE   a service's output; snapshots of one cycle must be equal
 *
 * Prints: reads R overlapped O torn T failed F. Overlapped: something was published during the read.
 * TABLE receives 2^20 pairs (cycle, CRC-32 of the snapshot), for comparison with the other readers.
 */
#include "surffollow.h"

#define TABLE_ENTRIES (1 << 20)

static int64_t reads, overlapped, torn, failed;

static int read_words(const char *path, size_t words, double seconds, int naive) {
  int64_t payload[512];
  const int fd = open(path, O_RDONLY);
  struct stat status;
  if (fd < 0 || fstat(fd, &status) != 0 || words > 512) return 1;
  const unsigned char *latch =
      (const unsigned char *)mmap(NULL, (size_t)status.st_size, PROT_READ, MAP_SHARED, fd, 0);
  const size_t bytes = words * 8;
  const int64_t end = sf_now_ns() + (int64_t)(seconds * 1e9);
  while (reads % 256 != 0 || sf_now_ns() < end) {
    const int64_t before = sf_load_acquire(latch);
    int64_t g = before;
    if (naive) {
      const unsigned char *slot =
          latch + SF_LATCH_HEAD_BYTES + sf_latch_stride(bytes) * (size_t)(g & (SF_LATCH_SLOTS - 1));
      for (size_t k = 0; k < words; k++) payload[k] = sf_load_relaxed(slot + 8 * k);
    } else {
      g = sf_latch_read(latch, bytes, payload);
    }
    reads++;
    overlapped += sf_load_relaxed(latch) != before;
    if (g <= 0) {
      failed += g < 0;
      continue;
    }
    int bad = !naive && payload[0] != g;
    for (size_t k = 1; k < words; k++) bad |= payload[k] != payload[0];
    torn += bad;
  }
  return 0;
}

static int read_output(const char *name, double seconds, const char *table_path) {
  sf_client c;
  sf_output first, now;
  const int result = sf_observe(&c, name);
  if (result != SF_OK) {
    fprintf(stderr, "%s: %s\n", name, sf_strerror(result));
    return 1;
  }
  const int fd = open(table_path, O_RDWR | O_CREAT | O_TRUNC, 0600);
  const size_t bytes = sizeof(int64_t) * 2 * TABLE_ENTRIES;
  if (fd < 0 || ftruncate(fd, (off_t)bytes) != 0) return 1;
  int64_t *table = (int64_t *)mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  const int64_t end = sf_now_ns() + (int64_t)(seconds * 1e9);
  memset(&first, 0, sizeof first);
  first.cycle = -1;
  while (reads % 256 != 0 || sf_now_ns() < end) {
    const int64_t before = sf_load_acquire(c.output);
    const int got = sf_read_output(&c, &now);
    reads++;
    overlapped += sf_load_relaxed(c.output) != before;
    if (got != SF_OK) {
      failed++;
      continue;
    }
    if (now.cycle == first.cycle) {
      torn += memcmp(&now, &first, sizeof now) != 0;
      continue;
    }
    torn += now.cycle < first.cycle || now.t_ns < first.t_ns; /* time runs backward */
    first = now;
    int64_t *entry = table + 2 * (now.cycle & (TABLE_ENTRIES - 1));
    entry[1] = sf_i_crc32(0, (const unsigned char *)&now, sizeof now);
    entry[0] = now.cycle;
  }
  sf_detach(&c);
  return 0;
}

int main(int argc, char **argv) {
  int result = 2;
  if (argc == 5 && strcmp(argv[1], "output") == 0)
    result = read_output(argv[2], strtod(argv[3], NULL), argv[4]);
  else if (argc == 5)
    result = read_words(argv[2], (size_t)strtol(argv[3], NULL, 10), strtod(argv[4], NULL), argv[1][0] == 'n');
  printf("reads %" PRId64 " overlapped %" PRId64 " torn %" PRId64 " failed %" PRId64 "\n", reads, overlapped, torn,
         failed);
  return result;
}
