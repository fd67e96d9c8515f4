"""Whether an effect holds where it was not fitted: views left out, ends of joints' ranges left out."""
