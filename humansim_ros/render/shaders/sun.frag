#version 330
#ifdef FINISH
in vec2 v_uv;
uniform float cutoff, opacity;
uniform bool masked;
uniform sampler2D cut;
void main() {
    if (masked && opacity * texture(cut, v_uv).r < cutoff) discard;
}
#else
void main() {}
#endif
