"""What travels: messages, the topics table, and their bytes."""
