"""What captures are worth: noise, range, glare, light, focus, charts; arrays in, numbers out."""
