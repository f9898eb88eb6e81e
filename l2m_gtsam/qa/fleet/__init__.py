"""What many drives of many vehicles say together."""
