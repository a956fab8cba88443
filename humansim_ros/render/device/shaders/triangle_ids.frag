#version 330
// Depth and triangle id at the pixel center.
in float v_z;
uniform uint first_id;
layout(location = 0) out float depth;
layout(location = 1) out uint triangle_id;
void main() {
    depth = v_z;
    triangle_id = first_id + uint(gl_PrimitiveID);
}
