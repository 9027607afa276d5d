"""One model of what an image shows of a body: effects with priors, and the linear looks at data that estimate them."""
