#version 330
#ifdef PBR
in vec2 v_uv;
uniform float cutoff, opacity;
uniform bool masked;
uniform sampler2D alpha_map;
void main() {
    if (masked && opacity * texture(alpha_map, v_uv).r < cutoff) discard;
}
#else
void main() {}
#endif
