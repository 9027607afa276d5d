KPL/FK

The camera frame whose attitudes giantlike wrote: +x along increasing columns, +y along increasing rows, +z boresight,
unless the camera file names a frame of the mission.

\begindata
FRAME_DAWN_FC2_MADE = -203999
FRAME_-203999_NAME = 'DAWN_FC2_MADE'
FRAME_-203999_CLASS = 3
FRAME_-203999_CLASS_ID = -203999
FRAME_-203999_CENTER = -203
CK_-203999_SCLK = -203
CK_-203999_SPK = -203
\begintext
