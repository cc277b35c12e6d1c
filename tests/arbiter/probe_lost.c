/* Print since when a part of a sum is lost, by the header; 0: it is not, or there is no such part. */
#include "surffollow_arbiter.h"

int main(int argc, char **argv) {
  sfa_client a;
  int part;
  if (argc < 3 || sfa_attach(&a, argv[1], "follow", 5000) != 0) return 1;
  part = sfa_resource(&a, argv[2]);
  printf("%lld\n", SF_CAST(long long, sfa_lost_since(&a, part)));
  part = sfa_lost_since(&a, SFA_RESOURCES) != 0 || sfa_lost_since(&a, -1) != 0;
  sfa_detach(&a);
  return part;
}
