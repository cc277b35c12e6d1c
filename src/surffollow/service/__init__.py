"""The daemon: cycle thread, map thread, main thread with requests and clients; checks of the host."""
