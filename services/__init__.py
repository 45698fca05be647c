"""The processes around the library: one file one process, wired as `services.topics` says."""
