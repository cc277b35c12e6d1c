/* ---- UpLoadMap: header and every grid to a text file (docs/reference/map-file-format.md) --------------- */

static inline uint32_t sf_i_crc32(uint32_t crc, const unsigned char *bytes, size_t n) {
  static const uint32_t nibble[16] = {0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u,
                                      0x4DB26158u, 0x5005713Cu, 0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu,
                                      0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
  crc = ~crc;
  for (size_t k = 0; k < n; k++) {
    crc ^= bytes[k];
    crc = (crc >> 4) ^ nibble[crc & 15u];
    crc = (crc >> 4) ^ nibble[crc & 15u];
  }
  return ~crc;
}

/* The shortest decimal number that reads back as `value`, in any locale; as Python prints it. */
static inline void sf_i_write_double(FILE *f, double value) {
  char text[40], digits[24];
  int precision = 0, n = 0, exponent = 0;
  if (!sf_i_is_finite(value)) {
    fputs("nan", f);
    return;
  }
  do {
    snprintf(text, sizeof text, "%.*e", precision, value);
  } while (strtod(text, NULL) - value != 0.0 && ++precision < 17);
  const char *p = text;
  if (*p == '-') fputc(*p++, f);
  for (; *p != 'e' && *p != '\0'; p++)
    if (*p >= '0' && *p <= '9' && n < 20) digits[n++] = *p;
  if (*p == 'e') exponent = SF_CAST(int, strtol(p + 1, NULL, 10));
  while (n > 1 && digits[n - 1] == '0') n--;
  digits[n] = '\0';
  if (exponent < -4 || exponent >= 16) {
    fprintf(f, "%c%s%se%c%02d", digits[0], n > 1 ? "." : "", digits + 1, exponent < 0 ? '-' : '+',
            exponent < 0 ? -exponent : exponent);
    return;
  }
  if (exponent < 0) {
    fputs("0.", f);
    for (int k = exponent + 1; k < 0; k++) fputc('0', f);
    fputs(digits, f);
    return;
  }
  for (int k = 0; k <= exponent || k < n; k++) {
    if (k == exponent + 1) fputc('.', f);
    fputc(k < n ? digits[k] : '0', f);
  }
  if (n <= exponent + 1) fputs(".0", f);
}

/* Grid i of a copied map: its height in quanta (what 0) or its count (what 1). */
static inline int sf_i_grid(const sf_grid_pair *pairs, int64_t i, int what) {
  const sf_grid_pair *pair = pairs + i / 2;
  return what == 0 ? pair->h[i % 2] : pair->c[i % 2];
}

/* One row; runs of four or more as value*times, unless nearly all neighbours differ. */
static inline uint32_t sf_i_write_row(FILE *f, const sf_grid_pair *pairs, int64_t start, int64_t nx, int what,
                                      uint32_t crc) {
  int64_t changes = 0;
  for (int64_t k = 0; k < nx; k++) {
    const int value = sf_i_grid(pairs, start + k, what);
    const unsigned char bytes[2] = {SF_CAST(unsigned char, value & 0xFF), SF_CAST(unsigned char, value >> 8 & 0xFF)};
    crc = sf_i_crc32(crc, bytes, what == 0 ? 2 : 1);
    if (k > 0) changes += value != sf_i_grid(pairs, start + k - 1, what);
  }
  const int plain = changes > nx * 3 / 4;
  for (int64_t k = 0, run; k < nx; k += run) {
    const int value = sf_i_grid(pairs, start + k, what);
    run = 1;
    if (!plain)
      while (k + run < nx && sf_i_grid(pairs, start + k + run, what) == value) run++;
    if (run >= 4) {
      fprintf(f, "%s%d*%" PRId64, k > 0 ? " " : "", value, run);
      continue;
    }
    for (int64_t times = 0; times < run; times++) fprintf(f, "%s%d", k + times > 0 ? " " : "", value);
  }
  fputc('\n', f);
  return crc;
}

static inline void sf_i_write_numbers(FILE *f, const sf_map_header *h) {
  static const char *const whole[] = {"nx", "ny", "datum_set", "datum_auto", "gate_min_count"};
  const int64_t wholes[] = {h->nx, h->ny, h->datum_set, h->datum_auto, h->gate_min_count};
  static const char *const counter[] = {"dither_count", "dither_offset", "samples", "outside",
                                        "clipped", "gated", "invalid"};
  const int64_t counters[] = {h->dither_count, h->dither_offset, h->samples, h->outside,
                              h->clipped, h->gated, h->invalid};
  static const char *const real[] = {"grid_m", "x0_m", "y0_m", "datum_m", "quantum_m", "finest_grid_m", "gate_m"};
  const double reals[] = {h->grid_m, h->x0_m, h->y0_m, h->datum_m, h->quantum_m, h->finest_grid_m, h->gate_m};
  for (size_t k = 0; k < 5; k++) fprintf(f, "%s %" PRId64 "\n", whole[k], wholes[k]);
  fprintf(f, "dither_seed %" PRIu64 "\n", h->dither_seed);
  for (size_t k = 0; k < 7; k++) fprintf(f, "%s %" PRId64 "\n", counter[k], counters[k]);
  for (size_t k = 0; k < 7; k++) {
    fprintf(f, "%s ", real[k]);
    sf_i_write_double(f, reals[k]);
    fputc('\n', f);
  }
}

static inline void sf_i_write_head(FILE *f, const sf_map_header *h) {
  fputs("surffollow-map 1\n", f);
  fputs("# rows ascend in y, columns in x; x0_m, y0_m: outer corner of the first grid\n", f);
  fprintf(f, "# height [m] = datum_m + quantum_m * value; %d is unknown; v*n is n times v\n", SF_MAP_UNKNOWN_HEIGHT);
  sf_i_write_numbers(f, h);
  fputs("region_m", f);
  for (int k = 0; k < 4; k++) {
    fputc(' ', f);
    sf_i_write_double(f, h->region_m[k]);
  }
  fprintf(f, "\nrounding %s\n", h->rounding == SF_MAP_ROUND_PAPER ? "paper" : "unbiased");
}

/* 0 when there is no memory for the header; errors of the file are its own. */
static inline int sf_i_write_map(FILE *f, const sf_map_header *h, const sf_grid_pair *pairs) {
  const int64_t grids = h->nx * h->ny;
  char *head = NULL;
  size_t size = 0;
  FILE *memory = open_memstream(&head, &size);
  if (memory == NULL) return 0;
  sf_i_write_head(memory, h);
  const int whole = !ferror(memory);
  if (fclose(memory) != 0 || !whole) {
    free(head);
    return 0;
  }
  fwrite(head, 1, size, f);
  fprintf(f, "head_crc %08" PRIx32 "\n", sf_i_crc32(0, SF_VIEW(const unsigned char *, head), size));
  free(head);
  uint32_t crc = 0;
  for (int what = 0; what < 2; what++) {
    fputs(what == 0 ? "heights\n" : "counts\n", f);
    for (int64_t start = 0; start < grids; start += h->nx) crc = sf_i_write_row(f, pairs, start, h->nx, what, crc);
  }
  fprintf(f, "end %08" PRIx32 "\n", crc);
  return 1;
}

/* Copy header and grids under exclusive access; the caller frees `*pairs`. */
static inline int sf_i_copy_map(sf_client *c, sf_map_header *header, sf_grid_pair **pairs) {
  const sf_map_header *h = sf_i_map(c);
  *pairs = NULL;
  if (h == NULL) return sf_i_no_map(c);
  int err = sf_access_begin(c, c->options.timeout_ns);
  if (err != SF_OK) return err;
  h = sf_i_map(c); /* beginning may have followed the service to a new start */
  if (h == NULL) {
    sf_access_end(c);
    return SF_ERR_BLOCK;
  }
  memcpy(header, h, sizeof *header);
  if (header->state != SF_MAP_READY)
    err = header->state == SF_MAP_NO_MAP ? SF_REFUSED_NO_MAP : SF_REFUSED_MAP_BUSY;
  else if (!sf_i_map_holds(c, header->nx, header->ny))
    err = SF_ERR_BLOCK;
  if (err == SF_OK) {
    const size_t bytes = SF_CAST(size_t, (header->nx * header->ny + 1) / 2) * sizeof **pairs;
    *pairs = SF_CAST(sf_grid_pair *, malloc(bytes));
    if (*pairs == NULL)
      err = SF_ERR_MEMORY;
    else
      memcpy(*pairs, c->map.memory + SF_MAP_HEADER_BYTES, bytes);
  }
  const int ended = sf_access_end(c);
  return err != SF_OK ? err : ended;
}

/* How many bytes of a path lead to its folder, the last slash included. */
static inline size_t sf_i_folder(const char *path) {
  const char *slash = strrchr(path, '/');
  return slash == NULL ? 0 : SF_CAST(size_t, slash - path) + 1;
}

/* Whether a file's name ends in the suffix of another format than the map's text file: a reader goes by it. */
static inline int sf_i_is_other_format(const char *path) {
  static const char *const others[] = {".npz", ".asc", ".tif", ".tiff", ".ply",
                                       ".xyz", ".las", ".png", ".svg", ".pdf"};
  const char *name = path + sf_i_folder(path);
  while (*name == '.') name++; /* a dot at the beginning begins no suffix */
  const char *suffix = strrchr(name, '.');
  for (size_t k = 0; suffix != NULL && k < sizeof others / sizeof others[0]; k++)
    if (strcasecmp(suffix, others[k]) == 0) return 1;
  return 0;
}

/* Where a file of this name lies when links are followed; 0, or an errno: EEXIST, it is no plain file. */
static inline int sf_i_plain_target(const char *path, char target[4096], mode_t *mode) {
  char link[4096];
  struct stat status;
  size_t n = strlen(path);
  if (n >= 4096) return ENAMETOOLONG;
  memcpy(target, path, n + 1);
  for (int hops = 0;; hops++) {
    const ssize_t got = readlink(target, link, sizeof link);
    if (got < 0) break;
    const size_t folder = link[0] == '/' ? 0 : sf_i_folder(target);
    n = SF_CAST(size_t, got);
    if (hops == 40) return ELOOP;
    if (folder + n >= 4096) return ENAMETOOLONG;
    memcpy(target + folder, link, n);
    target[folder + n] = '\0';
  }
  *mode = 0;
  if (stat(target, &status) != 0) return 0; /* nothing there; what else is wrong shows when it is written */
  *mode = status.st_mode & 0777;
  return S_ISREG(status.st_mode) ? 0 : EEXIST; /* to rename over a device or a pipe would take its place */
}

/* After a rename: without this a power cut may undo it. */
static inline void sf_i_sync_folder(char path[4096]) {
  const size_t n = sf_i_folder(path);
  path[n] = '\0';
  const int fd = open(n > 0 ? path : ".", O_RDONLY | O_CLOEXEC);
  if (fd < 0) return;
  fsync(fd);
  close(fd);
}

/*
 * Write the map's header and all grids to a text file, with this process's own rights (paper: UpLoadMap).
 * The map stands still only while it is copied; the file appears whole or not at all. Links are followed;
 * what is there and is no plain file stays: SF_ERR_FILE with EEXIST in the client's `detail`. A name that
 * ends in the suffix of another format (.npz .asc .tif .tiff .ply .xyz .las .png .svg .pdf) is refused: SF_ERR_FILE
 * with EINVAL.
 */
static inline int sf_upload_map(sf_client *c, const char *path) {
  char part[4096 + 64], target[4096];
  mode_t mode = 0;
  sf_map_header header;
  sf_grid_pair *pairs;
  if (c == NULL || c->output == NULL || path == NULL || path[0] == '\0') return SF_ERR_ARGUMENT;
  int number = sf_i_is_other_format(path) ? EINVAL : sf_i_plain_target(path, target, &mode);
  int err = number == 0 ? sf_i_copy_map(c, &header, &pairs) : SF_ERR_FILE;
  if (number != 0) c->detail = number;
  if (err != SF_OK) {
    if (number == 0) free(pairs);
    return err;
  }
  int written = 0, fd = -1;
  for (int tries = 0; fd < 0 && tries < 8; tries++) { /* a part of a process that was killed may be there */
    snprintf(part, sizeof part, "%s.%06x.part", target, SF_CAST(unsigned, sf_i_random_claim() >> 8 & 0xFFFFFF));
    fd = open(part, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0666);
    if (fd < 0 && errno != EEXIST && errno != EINTR) break;
  }
  FILE *f = fd >= 0 ? fdopen(fd, "w") : NULL;
  number = errno;
  if (f != NULL) {
    errno = 0;
    if (mode != 0) (void)!fchmod(fd, mode); /* as the file that it replaces */
    written = sf_i_write_map(f, &header, pairs) && !ferror(f) && fflush(f) == 0 && fsync(fd) == 0;
    number = errno;
    if (fclose(f) != 0 && written) written = 0, number = errno;
    if (written && rename(part, target) != 0) written = 0, number = errno;
  }
  free(pairs);
  if (written) {
    sf_i_sync_folder(target);
    return SF_OK;
  }
  if (f == NULL && fd >= 0) close(fd);
  if (fd >= 0) unlink(part);
  c->detail = number;
  return SF_ERR_FILE;
}

#ifdef __cplusplus
} /* extern "C" */
#endif

#endif /* SURFFOLLOW_H */
