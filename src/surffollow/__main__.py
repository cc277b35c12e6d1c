"""`python -m surffollow`: the command line without an installed script."""

from surffollow.cli.entry import main

main()
