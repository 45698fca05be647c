"""The processes around the library: one file one process, wired as `services.topics` says."""

RUST_LOG = "error,zenoh::api::session=off"
"""What Rerun and Zenoh say where the environment asks for nothing else.

Rerun warns of every file without a footer, which ours are on purpose; what Zenoh says of messages that
reach a session before it is complete is counted by our readers.
"""
