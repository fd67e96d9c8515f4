"""What these views can show: detectable sizes, aliases, bias of the hand-eye by omitted effects."""
