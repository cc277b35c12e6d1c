"""`python -m surffollow`: the command line without an installed script."""

from surffollow.cli.main import main

main()
