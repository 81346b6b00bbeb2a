"""Several hosts on one machine: network namespaces, links with a rate, a delay and losses, and a rig to load them."""
