"""One line under every figure: what to read from it."""

FIELD = (
    "Per place of the part, how far each view puts the surface from where the others put it, averaged over a patch so "
    "that the scanner's noise is gone. What fades from one step to the next is what that step explained. Hatched: seen "
    "by one view only."
)
CARRIED_TARGETS = (
    "In the frame of the robot's base. Every target stands wherever a view saw it on the arm; its colour says how far "
    "off its place it was seen there. What fades from one step to the next is what that step explained. Grey: the "
    "robot's base, and the scanner if it stands near."
)
SEEN_TARGETS = (
    "In the frame of the robot's base. Balls are the targets, pyramids the scanner where each view was taken; colours "
    "say how far off their place the targets were seen (rms, of a target over its views, of a view over its targets). "
    "What fades from one step to the next is what that step explained. Grey: the robot's base."
)
HANDLING = "Drag to turn, click and scroll to come closer."
BUDGET = (
    "Of how far whole views lie from where the robot and one hand-eye put them: how large each source is (rms), and "
    "its share of the variance; the shares add up to 100 %. White repeatability is the arm's scatter, new in every "
    "view as the noise is. Noise and scanner field, what the scanner errs by over its field, count as far as they move "
    "whole views: single points are off by more. What repeats can be corrected once it has a name."
)
MEAN_SQUARES = "Shares of the mean square: what noise explains, what the named effects explain, and the rest."
SCANNER_FIELD = (
    "How much too far (red) or too near (blue) the scanner sees a point, by the direction in which it sees it, the "
    "same in every view: {size} rms, with a standard uncertainty of {sigma}. Grey: too few points. Found from where "
    "views overlap. What moving the views does as well no overlap shows, so that a constant, a slope and a bowl over "
    "the field are not in it; nor is what is finer than a sixth of the field. Before correcting by it, have it "
    "confirmed by a calibration of the scanner, which shows those too."
)
SHAPE = "Mean displacement in bins with two sigmas. Bars that all reach zero follow nothing."
COURSES = (
    "How far a joint is off along what its error follows, an angle, its last move, time or a load, beside its mean and "
    "with two sigmas. The percentage is the share of all that the joint does without a name. Dashes: where views "
    "stood. Beyond them nothing is known."
)
TIME_COURSE = (
    "As if the flange were off by so much in time, along its own axes, with two sigmas. Dashes: when "
    "views were taken. The sigmas are those of a course of this very shape."
)
ALIASES = (
    "1 in a row: in these views the effect of the column can do the same, and only other views or an artefact "
    "tell the two apart."
)
COMPARISON = (
    "Signed mean distance between the views against each property with two sigmas, clearest first; "
    "a slope or a bend is what the model does not know. The sample is the view."
)
TWO_FIELDS = (
    "Per place of the part, how far each view puts the surface from where the others put it, by the model of each run; "
    "one scale of colours for both. Hatched: seen by one view only."
)
HANDLING_OF_TWO = "Drag to turn: both turn."
WATCHED = (
    "Dots: what the sessions found. Blue: smoothed, with two sigmas. Green: the calibration in use, dotted how far a "
    "parameter may be off. Red: something happened, a line for a step, dashes for a drift."
)
