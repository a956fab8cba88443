#version 330
// Points and normals of the static scene as it is laid out in the light map.
in vec3 v_world;
in vec3 v_normal;
layout(location = 0) out vec4 point;   // w: 1
layout(location = 1) out vec4 normal;
void main() {
    point = vec4(v_world, 1.0);
    normal = vec4(normalize(v_normal), 0.0);
}
