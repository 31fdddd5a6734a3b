# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Where every method fails
#
# One row is a case in which methods of an effect fail, in the literature or here. Each small
# image is what one method makes of it, in the order in which the sections below list them;
# red marks what is wrong, missing or not a number. *Pass* counts the methods whose figures are
# all within what the case asks. The last column is about derivatives, as they are in that case:
#
# - **zero**: that of what is computed is 0, and nothing can be fitted through it;
# - **biased**: there is a derivative, but not that of what the image should be;
# - **missing**: the true one has a part, of what jumps or comes into sight, that ours lacks;
# - **none**: integers, files, and peers that are not differentiated.

# %%
import sys

from IPython.display import HTML


sys.path.append("..")
from benchmarks import stability


HTML(stability.overview())

# %% [markdown]
# Every figure is an error, 0 at best. The figures are published in `docs/stability`, where
# `python -m benchmarks.stability` writes them. `pytest -m stability` measures every case again:
# a figure that met its bound must meet it, and one that failed or is only watched must stay
# below 1.5 times the published one. What a case asks stands above its figures; what it asks
# nothing of is *watched*.
#
# ## Depth of field
#
# Images of 46 x 46 pixels, circles of at most 12. *Bias* is the error of the derivative in
# the logarithm of the aperture against the closed form's, over the same band as the image's
# error; *gradient* is how far derivatives in aperture, focus and depth lie outside the method's
# own two one-sided difference quotients.

# %%
HTML(stability.section("dof"))

# %% [markdown]
# ## Gaussian blur

# %%
HTML(stability.section("blur"))

# %% [markdown]
# ## Reprojection

# %%
HTML(stability.section("reproject"))

# %% [markdown]
# ## Shadow maps

# %%
HTML(stability.section("shadow"))

# %% [markdown]
# ## Relighting

# %%
HTML(stability.section("relight"))

# %% [markdown]
# ## What the table cannot tell
#
# - **Which method to take.** A figure is that of one small scene, chosen so that something goes
#   wrong in it. How often it does in your images, and what a method costs, is what the charts
#   of each effect are for.
# - **Whether a pass is a proof.** It says that one image was within a bound. What holds for
#   all images is tested elsewhere, on random ones: that a kernel's sums are those of a plain
#   loop, that a bad pixel stays local, that a derivative is the difference quotient.
# - **What a bound is worth.** Those that equations give (energy, centroid, a mask that misses
#   nothing) are what they should be. Those of images (an error of 0.02 in a band, a share of
#   holes) were chosen, and another choice moves a method from one side to the other.
# - **How a failure looks in motion.** *Jump* and *unevenness* are all that there is of time.
# - **Derivatives elsewhere.** They are compared along a few directions, at one point of each
#   case. *Exact* means that no difference was found there; each function's docstring says what
#   holds in general. A derivative that is exact for the method and *biased* against the truth
#   still leads a fit to the wrong place, as in *blurred foreground*.
# - **Time.** No row holds a wall-clock time, for a busy machine would fail it.
