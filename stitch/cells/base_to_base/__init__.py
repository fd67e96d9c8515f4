"""Base to base of two robots that cannot reach each other, through a stand with a rail and a measuring rod."""
