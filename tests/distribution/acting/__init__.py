"""Stand-in services: real topics, no work. The tests write what they would write."""
