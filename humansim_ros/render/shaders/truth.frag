#version 330
// Depth and the number of the triangle at the pixel's centre.
in float v_z;
uniform uint first_label;
layout(location = 0) out float depth;
layout(location = 1) out uint label;
void main() {
    depth = v_z;
    label = first_label + uint(gl_PrimitiveID);
}
