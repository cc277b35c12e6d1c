"""The embedders' interface: `Follower`, the service's kernels in process."""

from surffollow.follower.in_process import Follower

__all__ = ["Follower"]
